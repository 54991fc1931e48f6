"""A cortex at work before a gatekeeper: a planner that never stops deciding, the live view with a page, contracts.

The arm is never left waiting for words: while the planner (a process of its own) decides on the next contract, the one
before is carried out; where none is ready, or the gate has refused it, a given errand is.
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

from dualbrain.cli.common.paths import cache_folder
from dualbrain.cli.run.live_feed import LiveFeed
from dualbrain.contracts.gate.authorization import PLANNER
from dualbrain.contracts.schema import decoding_schema, describe_skills
from dualbrain.control.gatekeeper.config import GatekeeperConfig
from dualbrain.control.gatekeeper.protocol.authentication import load_or_create_keys
from dualbrain.control.gatekeeper.protocol.client import GatekeeperClient
from dualbrain.control.gatekeeper.protocol.messages import EventReport, Message, RequestRefused, TickReport
from dualbrain.control.recording.trace import Event
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
"""To and fro, and never into the bowl: a cube that lies in there cannot be grasped, and the day would be over."""
SPEED = 0.3
CONTRACT_TIMEOUT_S = 120.0
"""No contract takes longer [s]."""
PAGE_CLIENT_SCRIPT = """
import sys
from websockets.sync.client import connect
pieces = size = 0
try:
    with connect(sys.argv[1], subprotocols=[sys.argv[2]], max_size=None, ping_interval=None) as link:
        for piece in link:
            pieces, size = pieces + 1, size + len(piece)
            print(pieces, size, flush=True)
except Exception as why:
    print(f"the page ended: {type(why).__name__}", file=sys.stderr)
"""
"""A page that takes everything it is sent, as a browser does, and draws nothing: there is no display here."""


@dataclass
class LoadSummary:
    """What was done: contracts by who made them, outcomes and why, decisions [s each], what the page was sent."""

    contracts: Counter[str] = field(default_factory=Counter)
    outcomes: Counter[str] = field(default_factory=Counter)
    reasons: Counter[str] = field(default_factory=Counter)
    decisions: list[float] = field(default_factory=list)
    page: tuple[int, int] = (0, 0)


def run_load(plan: GatekeeperConfig, scene: str, planner: str, seconds: float, folder: Path) -> LoadSummary:
    """Command the gatekeeper of `plan`, in `scene`, for `seconds` with `planner`; what this leaves lies in `folder`."""
    day = LoadSummary()
    with ExitStack() as stack:
        config = RunConfig(
            instruction=INSTRUCTIONS[0],
            out=folder / "day",
            ledger=folder / "ledger.sqlite",
            cache=cache_folder(),
            robot=plan.robot,
            scene=scene,
            planner=planner,
        )
        backend = GatekeeperBackend()
        clocks = Clocks(time.monotonic, "", time.time)
        session = stack.enter_context(Session(config, clocks, os.environ, backend=backend))
        lookout = LiveFeed(session, backend, 8100, Console(stderr=True, quiet=True))
        stack.callback(lookout._view.close)
        page = stack.enter_context(_start_page_client(lookout._view.url))
        stack.callback(page.terminate)

        def watch(message: Message) -> None:
            if isinstance(message, TickReport):
                lookout.on_tick_report(message)
            elif isinstance(message, EventReport):
                lookout.on_event(Event(message.t, "operator", message.text))

        link = GatekeeperClient(Path(plan.socket), load_or_create_keys(Path(plan.keys)), PLANNER, on_report=watch)
        stack.callback(link.close)
        over = Signal()
        decided: Queue[bytes] = Queue(1)
        thread = Thread(target=_planning_loop, args=(session, link, decided, day, over), name="decider", daemon=True)
        thread.start()
        _command_loop(link, decided, day, time.monotonic() + seconds)
        over.set()
        page.terminate()
        heard = (page.stdout.read() if page.stdout else "").split("\n")
        day.page = tuple(map(int, heard[-2].split())) if len(heard) > 1 else (0, 0)
    return day


def _start_page_client(url: str) -> subprocess.Popen[str]:
    import viser  # noqa: PLC0415  (an extra)

    flags = ["-S"] if sys.flags.no_site else []
    words = [
        sys.executable,
        *flags,
        "-c",
        PAGE_CLIENT_SCRIPT,
        url.replace("http", "ws", 1),
        f"viser-v{viser.__version__}",
    ]
    return subprocess.Popen(words, stdout=subprocess.PIPE, text=True)


def _planning_loop(
    session: Session, link: GatekeeperClient, decided: Queue[bytes], day: LoadSummary, over: Signal
) -> None:
    """Ask the planner again and again; the newest answer waits to be carried out."""
    registry = skill_registry(session.robot_model)
    for count, instruction in enumerate(cycle(INSTRUCTIONS)):
        if over.is_set():
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
        began = time.monotonic()
        proposal = session.planner.propose(request)
        day.decisions.append(time.monotonic() - began)
        if not decided.full():
            decided.put(proposal.text.encode("utf-8", "replace"))


def _command_loop(link: GatekeeperClient, decided: Queue[bytes], day: LoadSummary, until: float) -> None:
    """One contract after the other, until the time is up and the last is over."""
    given = cycle(DESTINATIONS)
    while time.monotonic() < until:
        try:
            who, text = "planner", decided.get_nowait()
        except Empty:
            who, text = "given", _fallback_contract(link, next(given), sum(day.contracts.values()))
        answer = link.propose(text, link.request_scene().scene.version)
        if isinstance(answer, RequestRefused) or answer.rejected is not None:
            day.contracts[f"{who}, refused"] += 1
            time.sleep(0.2)
            continue
        day.contracts[f"{who}, accepted"] += 1
        outcome = link.wait_for_outcome(CONTRACT_TIMEOUT_S).outcome
        day.outcomes[outcome.kind] += 1
        day.reasons[outcome.reason] += 1


def _fallback_contract(link: GatekeeperClient, destination: str, number: int) -> bytes:
    """Fetch the red cube and put it down at `destination`; just put it down, where it is held already."""
    context: dict[str, Any] = {"robot": link.welcome.robot, "registry": link.welcome.registry}
    actions = pick_and_place_actions(speed=SPEED, destination=destination)[link.request_scene().holding is not None :]
    return msgspec.json.encode({"id": f"c-{number % 10_000:04d}", "context": context, "action_sequence": actions})
