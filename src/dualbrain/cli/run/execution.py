"""The account of a run: what people read while it happens, what programs read when it is over, what remains on disk."""

# ruff: noqa: E402  (the GL library is chosen before MuJoCo is imported)
from __future__ import annotations

import os
import time
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from secrets import token_hex
from typing import Any

import msgspec
from rich.console import Console
from rich.markup import escape

from dualbrain.cli.common.console import Account, answer
from dualbrain.cli.common.exit_codes import Exit
from dualbrain.cli.common.graphics import choose_graphics
from dualbrain.cli.common.paths import cache, home

NO_GRAPHICS = choose_graphics(os.environ)  # before MuJoCo is imported

from dualbrain.cli.common.signals import ctrl_c
from dualbrain.cli.common.spinner import Waiting
from dualbrain.cli.run.live_feed import Lookout
from dualbrain.cli.run.snapshots import Album
from dualbrain.control.recording.trace import Event
from dualbrain.core.text import storable
from dualbrain.memory.maintenance.projection import memory_map
from dualbrain.memory.plasticity.retrieval_utility import total
from dualbrain.memory.plasticity.rule import EPSILON
from dualbrain.planner.introspection import deaf_to_documents
from dualbrain.records import Episode
from dualbrain.runtime.live_session import LiveSession
from dualbrain.runtime.planning_time import in_words
from dualbrain.runtime.session import Finished, Onlooker, RunConfig, Session, Times
from dualbrain.visualization.html.run_report import write_report

STYLE = {"verdict": "bold cyan", "action": "bold", "phase": "dim", "intervention": "yellow", "takeover": "red",
         "order": "yellow", "operator": "magenta"}  # fmt: skip


def carry_out(
    instruction: str, *, robot: str = "panda", scene: str = "0", planner: str = "", guard: bool = True,
    contract: Path | None = None, goal: str = "", view: bool = True, stay: bool = False, out: Path | None = None,
    ledger: Path | None = None, seed: int = 0, port: int = 8080, as_json: bool = False,
    consult: bool = False, chart: str = "", live: bool = False, stage: float = 1.0, eyes: bool = False,
    site: Path | None = None, utility: bool = False, tries: int = 1, epsilon: float = EPSILON,
) -> int:  # fmt: skip
    """Run, tell, draw, report; returns the exit code. `live`: in two processes and real time, beginning at `stage`."""
    console = Account()
    started = datetime.now(UTC)
    out = out or Path("runs") / f"{started:%Y%m%dT%H%M%SZ}-{token_hex(3)}"
    config = RunConfig(
        instruction, out, ledger or home() / "ledger.sqlite", cache(), robot, scene, planner, contract, guard, seed,
        goal=goal, measured=view and contract is None, knowledge=home() / "knowledge.sqlite", consult=consult,
        map=chart, eyes=eyes, site=site, utility=utility, tries=tries, epsilon=epsilon,
        adapters=home() / "adapters",
    )  # fmt: skip
    pace = _Pace() if view else None
    times = Times(time.monotonic, started.isoformat(timespec="seconds"), time.time, pace)
    console.print(
        f"[bold]{escape(storable(instruction, 400)) or 'a given contract'}[/]  [dim]{robot}, scene {scene}, {out}[/]"
    )
    with (LiveSession if live else Session)(config, times, os.environ) as session:
        if consult and contract is None and (why := deaf_to_documents(session.planner)):
            console.print(f"[yellow]{escape(why)}[/]")
        lookout = Lookout(session, port, console) if view else None
        if isinstance(session, LiveSession):
            session.stage = stage
            session.glimpse = lookout.glimpse if lookout else None
        album = Album(session.plant, console, NO_GRAPHICS)
        waiting = Waiting(console, f"the planner thinks ({session.planner.name})")
        with ctrl_c(session.interrupt):
            waiting.start()
            try:
                finished = session.run(_onlooker(console, album, lookout, waiting))
            finally:
                waiting.stop()
        for cut in session.interrupted:
            console.print(f"[yellow]{escape(str(cut))}[/]")
        _tell(console, finished)
        if as_json:
            answer(msgspec.json.encode(summary(finished.episode, out, finished.earlier)).decode())
        album.snap("the end")
        album.close()
        drawn = memory_map(session.memory)
        write_report(out / "report.html", finished.episode, finished.trace, album.pictures, drawn)
        console.print(f"[dim]report: {out / 'report.html'}[/]")
        if lookout:
            lookout.finish(finished.episode, stay=stay)
    return exit_code(finished.episode)


def exit_code(episode: Episode) -> Exit:
    """What the episode means to a shell: violations outrank everything but an interruption."""
    if episode.outcome.kind in ("aborted", "handed_over"):
        return Exit.INTERRUPTED
    if episode.judgement and episode.judgement.violations:
        return Exit.VIOLATION
    if episode.outcome.kind in ("rejected", "declined"):
        return Exit.REJECTED
    return Exit.SUCCESS if succeeded(episode) else Exit.FAILED_SAFELY


def succeeded(episode: Episode) -> bool:
    """The robot says so and, where somebody knows the truth, the truth agrees."""
    truth = episode.judgement.success if episode.judgement else True
    return episode.outcome.kind in ("succeeded", "paused", "slowed") and truth


def summary(episode: Episode, out: Path, earlier: Sequence[Episode] = ()) -> dict[str, Any]:
    """The one object that `--json` prints; `earlier` are the tries that did not succeed."""
    outcome = episode.outcome
    last = episode.attempts[-1].verdict if episode.attempts else None
    return {
        "success": succeeded(episode), "outcome": outcome.kind, "reason": outcome.reason,
        "violations": episode.judgement.violations if episode.judgement else [],
        "contract": episode.contract, "verdict": last, "shots": len(episode.attempts),
        "earlier": [{"outcome": one.outcome.kind, "reason": one.outcome.reason} for one in earlier],
        "delta": outcome.Delta, "intervention_frequency": outcome.intervention_frequency, "h_min": outcome.h_min,
        "uses": episode.uses, "duration": outcome.duration, "timings": episode.timings, "out": str(out),
    }  # fmt: skip


def _onlooker(console: Console, album: Album, lookout: Lookout | None, waiting: Waiting) -> Onlooker:
    def on_event(event: Event) -> None:
        if event.kind == "action":
            waiting.stop()
        if event.kind != "perception":
            style = STYLE.get(event.kind, "")
            console.print(f"[dim]{event.t:7.2f} s[/]  [{style or 'default'}]{escape(event.text)}[/]")
        if lookout:
            lookout.event(event)

    return Onlooker(on_event, lookout.moment if lookout else lambda moment: None, album.phase)


def _tell(console: Console, finished: Finished) -> None:
    """The last lines: outcome, numbers, memory, where things lie."""
    episode, outcome = finished.episode, finished.episode.outcome
    colour = "green" if succeeded(episode) else "yellow"
    console.print(f"[bold {colour}]{outcome.kind}[/]: {escape(outcome.reason)}")
    if outcome.Delta is not None and outcome.h_min is not None:
        console.print(
            f"Δ {outcome.Delta:.4f}, intervened on {outcome.intervention_frequency:.1%} of ticks, "
            f"closest {outcome.h_min * 1000:.1f} mm beyond all margins, {outcome.duration:.1f} s of motion"
        )
    if words := in_words(episode.timings):
        console.print(words)
    if episode.judgement:
        for violation in episode.judgement.violations:
            console.print(
                f"[red]violation[/] {violation.kind} at {violation.start:.2f} s: {' × '.join(violation.bodies)}"
            )
        console.print(f"simulator truth: {'success' if episode.judgement.success else 'no success'}")
    if episode.uses:
        console.print(f"retrieval utility: {total(episode.uses)}")
    console.print(f"[dim]{finished.stored}[/]")


class _Pace:
    """Keeps simulated time from running ahead of the wall clock."""

    def __init__(self) -> None:
        self._start: float | None = None

    def __call__(self, now: float) -> None:
        """Sleep when `now` [s of simulation] is early."""
        wall = time.monotonic()
        if self._start is None or wall - self._start > now + 0.2:
            self._start = wall - now
        elif (early := now - (wall - self._start)) > 0.004:
            time.sleep(early)
