"""The stage of `cortex`: a gatekeeper, a cortex that is doomed, who watches both, and the next commander."""

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
from dualbrain.control.gatekeeper.config import Plan
from dualbrain.control.gatekeeper.process import Process
from dualbrain.control.gatekeeper.protocol.authentication import open_keys
from dualbrain.control.gatekeeper.protocol.client import GatekeeperLink, LinkLost
from dualbrain.control.gatekeeper.protocol.messages import Glimpse, Message, News, Refused
from dualbrain.errors import InvalidSetup
from dualbrain.safety.supervisor.actions import Rung
from dualbrain.simulation.scenes.generators.catalogue import open_scene
from experiments.engine.experiment import Row

CHILD = Path(__file__).with_name("failing_commander.py")
PATIENCE = 60.0
"""No moment takes longer to come [s]; no promise."""


@dataclass
class Stage:
    """Gatekeeper, doomed cortex, and who watches both."""

    folder: Path
    process: Process
    stored: list[str] = field(default_factory=list)
    lines: list[str] = field(default_factory=list)
    phase: str = ""
    speed: float = 0.0

    def __post_init__(self) -> None:
        """Nobody commands yet."""
        self.watcher = GatekeeperLink(self.folder / "s", watch=self._see)
        self.child: subprocess.Popen[str] | None = None

    def begin(self, how: str, *, waits: bool) -> subprocess.Popen[str]:
        """Start the cortex; it stands before its contract (or, if it waits, behind the gate's answer)."""
        flags = ["-S"] if sys.flags.no_site else []
        words = [str(self.folder / name) for name in ("s", "keys", "ledger.sqlite")]
        self.child = child = subprocess.Popen(
            [sys.executable, *flags, str(CHILD), *words, how, "1" if waits else "0"], stdin=subprocess.PIPE,
            stdout=subprocess.PIPE, text=True,
        )  # fmt: skip
        Thread(target=self._hear, args=(child,), daemon=True).start()
        self.await_line("running" if waits else "ready")
        until("the ledger is written", lambda: len(self.stored) > 0)
        return child

    def await_line(self, line: str) -> None:
        """Until the cortex has said `line`."""
        until(line, lambda: line in self.lines or (self.child is not None and self.child.poll() is not None))
        if line not in self.lines:
            raise InvalidSetup("cortex", got="an early end", allowed="one that says: " + line)

    def order(self) -> Rung:
        """The order that was told last."""
        return Rung[self.watcher.beat.action] if self.watcher.beat else Rung.NONE

    def serves_again(self, *, dead: bool) -> Row:
        """How the contract of the next commander ends, if need be at the next gatekeeper, and when it comes [s]."""
        if dead:
            self.process.process.wait()
            self.process = gatekeeper(self.folder, "two")
        deadline = time.monotonic() + PATIENCE
        while time.monotonic() < deadline:
            try:
                link = GatekeeperLink(self.folder / "s", open_keys(self.folder / "keys"), PLANNER)
            except LinkLost:  # the one before is not forgotten yet
                time.sleep(0.02)
                continue
            try:
                return _served(link)
            finally:
                link.close()
        return {"next": "not let in", "next_at": inf}

    def leave(self) -> None:
        """Everything ends; what the cortex said until then has been heard."""
        if self.child is not None:
            self.child.kill()
            self.child.wait()
            if self.child.stdin:
                self.child.stdin.close()
            time.sleep(0.1)
        self.watcher.close()
        self.process.stop()

    def _hear(self, child: subprocess.Popen[str]) -> None:
        for line in child.stdout or ():
            word, _, name = line.strip().partition(" ")
            (self.stored if word == "stored" else self.lines).append(name or word)

    def _see(self, message: Message) -> None:
        match message:
            case News(kind="phase"):
                self.phase = message.text.rpartition(": ")[2]
            case Glimpse():
                self.speed = max(map(abs, message.u))
            case _:
                pass


def until(what: str, true: Callable[[], bool]) -> None:
    """Wait for a condition; raises `InvalidSetup` if it never comes."""
    deadline = time.monotonic() + PATIENCE
    while not true():
        if time.monotonic() > deadline:
            raise InvalidSetup("moment", got=f"none within {PATIENCE:.0f} s", allowed=what)
        time.sleep(0.001)


def gatekeeper(folder: Path, name: str) -> Process:
    return Process(
        Plan(
            "panda", open_scene("bare:0"), str(folder / "s"), str(folder / "keys"), report=str(folder / f"{name}.json")
        )
    )


def _served(link: GatekeeperLink) -> Row:
    """How a short contract ends, and when it came, in the robot's time [s]."""
    context = {"robot": link.welcome.robot, "registry": link.welcome.registry}
    actions = [{"skill": "hold", "params": {"duration": 0.5}}]
    text = msgspec.json.encode({"id": "c-0002", "context": context, "action_sequence": actions})
    until("the old contract is over", lambda: link.beat is not None and not link.beat.busy)
    sight = link.look()
    answer = link.propose(text, sight.scene.version)
    if isinstance(answer, Refused) or answer.rejected is not None:
        return {"next": "refused", "next_at": sight.now}
    return {"next": link.ended(PATIENCE).outcome.kind, "next_at": sight.now}
