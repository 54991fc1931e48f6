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

from dualbrain.cli.common.paths import cache
from dualbrain.cli.run.live_feed import Lookout
from dualbrain.contracts.gate.authorization import PLANNER
from dualbrain.contracts.schema import decoding_schema, short_form
from dualbrain.control.gatekeeper.config import Plan
from dualbrain.control.gatekeeper.protocol.authentication import open_keys
from dualbrain.control.gatekeeper.protocol.client import GatekeeperLink
from dualbrain.control.gatekeeper.protocol.messages import Glimpse, Message, News, Refused
from dualbrain.control.recording.trace import Event
from dualbrain.grounding.scene_summary import summarise
from dualbrain.grounding.vocabulary import scene_names
from dualbrain.planner.request import PlanRequest
from dualbrain.records import Recall
from dualbrain.runtime.live_session import LiveSession
from dualbrain.runtime.session import RunConfig, Times
from dualbrain.skills.registry import registry_of
from experiments.safety.closed_loop import errand

INSTRUCTIONS = ("put the red cube on the left of the table", "put the red cube on the right of the table")
DESTINATIONS = ("table_left", "table_right")
"""To and fro, and never into the bowl: a cube that lies in there cannot be grasped, and the day would be over."""
SPEED = 0.3
LONGEST = 120.0
"""No contract takes longer [s]."""
PAGE = """
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
class Workday:
    """What was done: contracts by who made them, outcomes and why, decisions [s each], what the page was sent."""

    contracts: Counter[str] = field(default_factory=Counter)
    outcomes: Counter[str] = field(default_factory=Counter)
    reasons: Counter[str] = field(default_factory=Counter)
    decisions: list[float] = field(default_factory=list)
    page: tuple[int, int] = (0, 0)


def work(plan: Plan, scene: str, planner: str, seconds: float, folder: Path) -> Workday:
    """Command the gatekeeper of `plan`, in `scene`, for `seconds` with `planner`; what this leaves lies in `folder`."""
    day = Workday()
    with ExitStack() as stack:
        config = RunConfig(
            INSTRUCTIONS[0], folder / "day", folder / "ledger.sqlite", cache(), plan.robot, scene, planner
        )
        session = stack.enter_context(LiveSession(config, Times(time.monotonic, "", time.time), os.environ))
        lookout = Lookout(session, 8100, Console(stderr=True, quiet=True))
        stack.callback(lookout._view.close)
        page = stack.enter_context(_page(lookout._view.url))
        stack.callback(page.terminate)

        def watch(message: Message) -> None:
            if isinstance(message, Glimpse):
                lookout.glimpse(message)
            elif isinstance(message, News):
                lookout.event(Event(message.t, "operator", message.text))

        link = GatekeeperLink(Path(plan.socket), open_keys(Path(plan.keys)), PLANNER, watch=watch)
        stack.callback(link.close)
        over = Signal()
        decided: Queue[bytes] = Queue(1)
        thread = Thread(target=_decide, args=(session, link, decided, day, over), name="decider", daemon=True)
        thread.start()
        _command(link, decided, day, time.monotonic() + seconds)
        over.set()
        page.terminate()
        heard = (page.stdout.read() if page.stdout else "").split("\n")
        day.page = tuple(map(int, heard[-2].split())) if len(heard) > 1 else (0, 0)
    return day


def _page(url: str) -> subprocess.Popen[str]:
    import viser  # noqa: PLC0415  (an extra)

    flags = ["-S"] if sys.flags.no_site else []
    words = [sys.executable, *flags, "-c", PAGE, url.replace("http", "ws", 1), f"viser-v{viser.__version__}"]
    return subprocess.Popen(words, stdout=subprocess.PIPE, text=True)


def _decide(session: LiveSession, link: GatekeeperLink, decided: Queue[bytes], day: Workday, over: Signal) -> None:
    """Ask the planner again and again; the newest answer waits to be carried out."""
    registry = registry_of(session.body)
    for count, instruction in enumerate(cycle(INSTRUCTIONS)):
        if over.is_set():
            return
        scene = link.look().scene
        names = scene_names(scene)
        request = PlanRequest(
            instruction, summarise(scene, None), Recall(), session.body.name, registry.hash,
            short_form(registry, names), decoding_schema(registry, names), contract_id=f"c-{count % 10_000:04d}",
        )  # fmt: skip
        began = time.monotonic()
        proposal = session.planner.propose(request)
        day.decisions.append(time.monotonic() - began)
        if not decided.full():
            decided.put(proposal.text.encode("utf-8", "replace"))


def _command(link: GatekeeperLink, decided: Queue[bytes], day: Workday, until: float) -> None:
    """One contract after the other, until the time is up and the last is over."""
    given = cycle(DESTINATIONS)
    while time.monotonic() < until:
        try:
            who, text = "planner", decided.get_nowait()
        except Empty:
            who, text = "given", _given(link, next(given), sum(day.contracts.values()))
        answer = link.propose(text, link.look().scene.version)
        if isinstance(answer, Refused) or answer.rejected is not None:
            day.contracts[f"{who}, refused"] += 1
            time.sleep(0.2)
            continue
        day.contracts[f"{who}, accepted"] += 1
        outcome = link.ended(LONGEST).outcome
        day.outcomes[outcome.kind] += 1
        day.reasons[outcome.reason] += 1


def _given(link: GatekeeperLink, destination: str, number: int) -> bytes:
    """Fetch the red cube and put it down at `destination`; just put it down, where it is held already."""
    context: dict[str, Any] = {"robot": link.welcome.robot, "registry": link.welcome.registry}
    actions = errand(speed=SPEED, destination=destination)[link.look().holding is not None :]
    return msgspec.json.encode({"id": f"c-{number % 10_000:04d}", "context": context, "action_sequence": actions})
