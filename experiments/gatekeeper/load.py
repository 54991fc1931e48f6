"""Load for a gatekeeper: a planner that generates without a pause, the live view with a connected page, contracts.

The arm does not wait for the planner: while the planner (a separate process) generates the next contract, the
gatekeeper executes the one before. If no contract of the planner is ready, a given contract is executed.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections import Counter
from contextlib import ExitStack
from dataclasses import dataclass, field
from itertools import cycle
from pathlib import Path
from queue import Empty, Queue
from threading import Event as Signal
from threading import Thread
from typing import Any

import msgspec
from rich.console import Console

from dualbrain.cli.run.live_feed import LiveFeed
from dualbrain.contracts.gate.authorization import PLANNER
from dualbrain.contracts.schema import decoding_schema, describe_skills
from dualbrain.control.gatekeeper.config import GatekeeperConfig
from dualbrain.control.gatekeeper.protocol.authentication import load_keys
from dualbrain.control.gatekeeper.protocol.client import GatekeeperClient
from dualbrain.control.gatekeeper.protocol.messages import EventReport, Message, RequestRefused, TickReport
from dualbrain.control.recording.trace import Event
from dualbrain.core.paths import cache_folder
from dualbrain.grounding.scene_summary import summarise_scene
from dualbrain.grounding.vocabulary import scene_names
from dualbrain.planner.request import PlanRequest
from dualbrain.records import RetrievedContext
from dualbrain.runtime.backends.gatekeeper import GatekeeperBackend
from dualbrain.runtime.session import Clocks, RunConfig, Session
from dualbrain.skills.registry import skill_registry
from experiments.safety.closed_loop import pick_and_place_actions

INSTRUCTIONS = ("put the red cube on the left of the table", "put the red cube on the right of the table")
DESTINATIONS = ("table_left", "table_right")
"""Alternating destinations; never the bowl, because a cube in the bowl cannot be grasped again."""
SPEED = 0.3
CONTRACT_TIMEOUT_S = 120.0
"""Longest wait for the outcome of a contract [s]."""
PAGE_CLIENT_SCRIPT = """
import sys
from websockets.sync.client import connect
messages = size = 0
try:
    with connect(sys.argv[1], subprotocols=[sys.argv[2]], max_size=None, ping_interval=None) as link:
        for message in link:
            messages, size = messages + 1, size + len(message)
            print(messages, size, flush=True)
except Exception as error:
    print(f"the page ended: {type(error).__name__}", file=sys.stderr)
"""
"""A page that receives everything a browser would receive, without drawing it."""


@dataclass(kw_only=True)
class LoadSummary:
    """Contracts by author, outcomes and their reasons, decision times [s], messages and bytes sent to the page."""

    contracts: Counter[str] = field(default_factory=Counter)
    outcomes: Counter[str] = field(default_factory=Counter)
    reasons: Counter[str] = field(default_factory=Counter)
    decisions: list[float] = field(default_factory=list)
    page: tuple[int, int] = (0, 0)


def run_load(gatekeeper: GatekeeperConfig, scene: str, planner: str, seconds: float, folder: Path) -> LoadSummary:
    """Command the running `gatekeeper` in `scene` with `planner` for `seconds`; files are written to `folder`."""
    summary = LoadSummary()
    with ExitStack() as stack:
        config = RunConfig(
            instruction=INSTRUCTIONS[0],
            out=folder / "day",
            ledger=folder / "ledger.sqlite",
            cache=cache_folder(),
            robot=gatekeeper.robot,
            scene=scene,
            planner=planner,
        )
        backend = GatekeeperBackend()
        clocks = Clocks(time.monotonic, "", time.time)
        session = stack.enter_context(Session(config, clocks, os.environ, backend=backend))
        quiet = Console(stderr=True, quiet=True)
        feed = LiveFeed(session.robot_model, session.plant, 8100, quiet, operate=backend.operate)
        stack.callback(feed.view.close)
        page = stack.enter_context(_start_page_client(feed.view.url))
        stack.callback(page.terminate)

        def watch(message: Message) -> None:
            if isinstance(message, TickReport):
                feed.on_tick_report(message)
            elif isinstance(message, EventReport):
                feed.on_event(Event(message.t, "operator", message.text))

        link = GatekeeperClient(
            Path(gatekeeper.socket), load_keys(Path(gatekeeper.keys), (PLANNER,)), PLANNER, on_report=watch
        )
        stack.callback(link.close)
        finished = Signal()
        planned: Queue[bytes] = Queue(1)
        thread = Thread(
            target=_planning_loop, args=(session, link, planned, summary, finished), name="planning", daemon=True
        )
        thread.start()
        _command_loop(link, planned, summary, time.monotonic() + seconds)
        finished.set()
        page.terminate()
        lines = (page.stdout.read() if page.stdout else "").split("\n")
        summary.page = tuple(map(int, lines[-2].split())) if len(lines) > 1 else (0, 0)
    return summary


def _start_page_client(url: str) -> subprocess.Popen[str]:
    import viser  # noqa: PLC0415  (an extra)

    flags = ["-S"] if sys.flags.no_site else []
    command = [
        sys.executable,
        *flags,
        "-c",
        PAGE_CLIENT_SCRIPT,
        url.replace("http", "ws", 1),
        f"viser-v{viser.__version__}",
    ]
    return subprocess.Popen(command, stdout=subprocess.PIPE, text=True)


def _planning_loop(
    session: Session, link: GatekeeperClient, planned: Queue[bytes], summary: LoadSummary, finished: Signal
) -> None:
    """Request plans without a pause; the oldest plan not yet proposed is kept in `planned`."""
    registry = skill_registry(session.robot_model)
    for count, instruction in enumerate(cycle(INSTRUCTIONS)):
        if finished.is_set():
            return
        scene = link.request_scene().scene
        names = scene_names(scene)
        request = PlanRequest(
            instruction=instruction,
            scene=summarise_scene(scene, None),
            recall=RetrievedContext(),
            robot=session.robot_model.name,
            registry_hash=registry.hash,
            skills_text=describe_skills(registry, names),
            schema=decoding_schema(registry, names),
            contract_id=f"c-{count % 10_000:04d}",
        )
        start = time.monotonic()
        proposal = session.planner.propose(request)
        summary.decisions.append(time.monotonic() - start)
        if not planned.full():
            planned.put(proposal.text.encode("utf-8", "replace"))


def _command_loop(link: GatekeeperClient, planned: Queue[bytes], summary: LoadSummary, until: float) -> None:
    """Run contracts one after another until the time is up and the last has ended."""
    destinations = cycle(DESTINATIONS)
    while time.monotonic() < until:
        try:
            author, text = "planner", planned.get_nowait()
        except Empty:
            author = "given"
            text = _fallback_contract(link, next(destinations), sum(summary.contracts.values()))
        answer = link.propose(text, link.request_scene().scene.version)
        if isinstance(answer, RequestRefused) or answer.rejected is not None:
            summary.contracts[f"{author}, refused"] += 1
            time.sleep(0.2)
            continue
        summary.contracts[f"{author}, accepted"] += 1
        outcome = link.wait_for_outcome(CONTRACT_TIMEOUT_S).outcome
        summary.outcomes[outcome.kind] += 1
        summary.reasons[outcome.reason] += 1


def _fallback_contract(link: GatekeeperClient, destination: str, number: int) -> bytes:
    """Return a contract that places the red cube at `destination`; it grasps the cube if it is not held yet."""
    context: dict[str, Any] = {"robot": link.welcome.robot, "registry": link.welcome.registry}
    actions = pick_and_place_actions(speed=SPEED, destination=destination)[link.request_scene().holding is not None :]
    return msgspec.json.encode({"id": f"c-{number % 10_000:04d}", "context": context, "action_sequence": actions})
