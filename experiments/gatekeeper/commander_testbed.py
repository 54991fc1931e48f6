"""Test bed of `commander_failure`: a gatekeeper, a commander that will fail, a watcher and the next commander."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from math import inf
from pathlib import Path
from threading import Thread

import msgspec

from dualbrain.contracts.gate.authorization import PLANNER
from dualbrain.control.gatekeeper.config import GatekeeperConfig
from dualbrain.control.gatekeeper.process import GatekeeperProcess
from dualbrain.control.gatekeeper.protocol.authentication import load_keys
from dualbrain.control.gatekeeper.protocol.client import ConnectionLostError, GatekeeperClient
from dualbrain.control.gatekeeper.protocol.messages import EventReport, Message, RequestRefused, TickReport
from dualbrain.errors import ConfigurationError
from dualbrain.safety.supervisor.actions import SafetyAction
from dualbrain.simulation.scenes.generators.catalogue import open_scene
from experiments.engine.experiment import Row

COMMANDER_SCRIPT = Path(__file__).with_name("failing_commander.py")
TIMEOUT_S = 60.0
"""Longest wait for a moment or an outcome [s]."""


@dataclass(kw_only=True)
class CommanderTestbed:
    """A gatekeeper process, a commander process that will fail, and a client that watches both."""

    folder: Path
    process: GatekeeperProcess
    stored: list[str] = field(default_factory=list)
    lines: list[str] = field(default_factory=list)
    phase: str = ""
    speed: float = 0.0

    def __post_init__(self) -> None:
        """Connect the watcher; no commander is started yet."""
        self.watcher = GatekeeperClient(self.folder / "s", on_report=self._on_message)
        self.commander: subprocess.Popen[str] | None = None

    def start_commander(self, how: str, *, waits: bool) -> subprocess.Popen[str]:
        """Start the commander; it pauses before it sends its contract (if it `waits`: after the answer of the gate)."""
        flags = ["-S"] if sys.flags.no_site else []
        paths = [str(self.folder / name) for name in ("s", "keys", "ledger.sqlite")]
        self.commander = child = subprocess.Popen(
            [sys.executable, *flags, str(COMMANDER_SCRIPT), *paths, how, "1" if waits else "0"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        Thread(target=self._read_output, args=(child,), daemon=True).start()
        self.await_line("running" if waits else "ready")
        wait_until("the first stored episode", lambda: len(self.stored) > 0)
        return child

    def await_line(self, line: str) -> None:
        """Wait until the commander has printed `line`; raises `ConfigurationError` if it ends before."""
        wait_until(
            line, lambda: line in self.lines or (self.commander is not None and self.commander.poll() is not None)
        )
        if line not in self.lines:
            raise ConfigurationError.stating(f"The commander process ended before it printed {line!r}.")

    def reported_action(self) -> SafetyAction:
        """Return the action that the last heartbeat reported."""
        return SafetyAction[self.watcher.status.action] if self.watcher.status else SafetyAction.NONE

    def run_next_contract(self, *, dead: bool) -> Row:
        """Run the contract of the next commander (of the next gatekeeper if `dead`); its outcome and start time [s]."""
        if dead:
            self.process.process.wait()
            self.process = start_gatekeeper(self.folder, "two", thread=bool(self.process.config.control_thread))
        deadline = time.monotonic() + TIMEOUT_S
        while time.monotonic() < deadline:
            try:
                link = GatekeeperClient(self.folder / "s", load_keys(self.folder / "keys", (PLANNER,)), PLANNER)
            except ConnectionLostError:  # the gatekeeper still holds the connection of the failed commander
                time.sleep(0.02)
                continue
            try:
                return _run_short_contract(link)
            finally:
                link.close()
        return {"next": "not let in", "next_at": inf}

    def shut_down(self) -> None:
        """End both processes, after every printed line of the commander has been read."""
        if self.commander is not None:
            self.commander.kill()
            self.commander.wait()
            if self.commander.stdin:
                self.commander.stdin.close()
            time.sleep(0.1)  # the reader thread reads the remaining lines
            if self.commander.stdout:
                self.commander.stdout.close()
        self.watcher.close()
        self.process.stop()

    def _read_output(self, child: subprocess.Popen[str]) -> None:
        for line in child.stdout or ():
            tag, _, name = line.strip().partition(" ")
            (self.stored if tag == "stored" else self.lines).append(name or tag)

    def _on_message(self, message: Message) -> None:
        match message:
            case EventReport(kind="phase"):
                self.phase = message.text.rpartition(": ")[2]
            case TickReport():
                self.speed = max(map(abs, message.u))
            case _:
                pass


def wait_until(description: str, condition: Callable[[], bool]) -> None:
    """Wait until `condition` is true; raises `ConfigurationError` after TIMEOUT_S."""
    deadline = time.monotonic() + TIMEOUT_S
    while not condition():
        if time.monotonic() > deadline:
            raise ConfigurationError.stating(f"Waited {TIMEOUT_S:.0f} s in vain for: {description}.")
        time.sleep(0.001)


def start_gatekeeper(folder: Path, name: str, *, thread: bool) -> GatekeeperProcess:
    """Start a gatekeeper on a scene without obstacles; its robot report is written to `name`.json."""
    return GatekeeperProcess(
        GatekeeperConfig(
            robot="panda",
            scene=open_scene("bare:0"),
            socket=str(folder / "s"),
            keys=str(folder / "keys"),
            report=str(folder / f"{name}.json"),
            control_thread=thread,
        )
    )


def _run_short_contract(link: GatekeeperClient) -> Row:
    """Return the outcome of a short contract and the time of its proposal on the clock of the robot [s]."""
    context = {"robot": link.welcome.robot, "registry": link.welcome.registry}
    actions = [{"skill": "hold", "params": {"duration": 0.5}}]
    text = msgspec.json.encode({"id": "c-0002", "context": context, "action_sequence": actions})
    wait_until("the end of the previous contract", lambda: link.status is not None and not link.status.busy)
    view = link.request_scene()
    answer = link.propose(text, view.scene.version)
    if isinstance(answer, RequestRefused) or answer.rejected is not None:
        return {"next": "refused", "next_at": view.now}
    return {"next": link.wait_for_outcome(TIMEOUT_S).outcome.kind, "next_at": view.now}
