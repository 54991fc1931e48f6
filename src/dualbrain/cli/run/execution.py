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

from dualbrain.cli.common.console import StderrConsole, print_result
from dualbrain.cli.common.exit_codes import ExitCode
from dualbrain.cli.common.graphics import choose_graphics
from dualbrain.cli.common.paths import cache_folder, dualbrain_home

NO_GRAPHICS_REASON = choose_graphics(os.environ)  # before MuJoCo is imported

from dualbrain.cli.common.signals import interrupt_handler
from dualbrain.cli.common.spinner import Spinner
from dualbrain.cli.run.live_feed import LiveFeed
from dualbrain.cli.run.snapshots import PhaseCamera
from dualbrain.control.recording.trace import Event
from dualbrain.core.text import storable_text
from dualbrain.memory.maintenance.projection import project_memories
from dualbrain.memory.plasticity.retrieval_utility import summarize_uses
from dualbrain.memory.plasticity.rule import EPSILON
from dualbrain.planner.introspection import no_documents_reason
from dualbrain.records import Episode
from dualbrain.runtime.live_session import LiveSession
from dualbrain.runtime.planning_time import format_timings
from dualbrain.runtime.session import Clocks, RunConfig, RunObserver, RunResult, Session
from dualbrain.visualization.html.run_report import write_report

EVENT_STYLES = {
    "verdict": "bold cyan",
    "action": "bold",
    "phase": "dim",
    "intervention": "yellow",
    "takeover": "red",
    "order": "yellow",
    "operator": "magenta",
}


def execute_run(
    instruction: str,
    *,
    robot: str = "panda",
    scene: str = "0",
    planner: str = "",
    guard: bool = True,
    contract: Path | None = None,
    goal: str = "",
    view: bool = True,
    keep_view_open: bool = False,
    out: Path | None = None,
    ledger: Path | None = None,
    seed: int = 0,
    port: int = 8080,
    as_json: bool = False,
    consult: bool = False,
    map_overlay: str = "",
    live: bool = False,
    speed_stage: float = 1.0,
    image_memory: bool = False,
    site: Path | None = None,
    utility: bool = False,
    tries: int = 1,
    epsilon: float = EPSILON,
) -> int:
    """Run, tell, draw, report; returns the exit code. `live`: in two processes and real time, beginning at `stage`."""
    console = StderrConsole()
    started = datetime.now(UTC)
    out = out or Path("runs") / f"{started:%Y%m%dT%H%M%SZ}-{token_hex(3)}"
    config = RunConfig(
        instruction=instruction,
        out=out,
        ledger=ledger or dualbrain_home() / "ledger.sqlite",
        cache=cache_folder(),
        robot=robot,
        scene=scene,
        planner=planner,
        contract=contract,
        guard=guard,
        seed=seed,
        goal=goal,
        measured=view and contract is None,
        knowledge=dualbrain_home() / "knowledge.sqlite",
        consult=consult,
        map=map_overlay,
        image_memory=image_memory,
        site=site,
        utility=utility,
        tries=tries,
        epsilon=epsilon,
        adapters=dualbrain_home() / "adapters",
    )
    pace = _RealTimePacer() if view else None
    times = Clocks(time.monotonic, started.isoformat(timespec="seconds"), time.time, pace)
    console.print(
        f"[bold]{escape(storable_text(instruction, 400)) or 'a given contract'}[/]  [dim]{robot}, scene {scene}, {out}[/]"
    )
    with (LiveSession if live else Session)(config, times, os.environ) as session:
        if consult and contract is None and (why := no_documents_reason(session.planner)):
            console.print(f"[yellow]{escape(why)}[/]")
        lookout = LiveFeed(session, port, console) if view else None
        if isinstance(session, LiveSession):
            session.speed_stage = speed_stage
            session.on_tick_report = lookout.on_tick_report if lookout else None
        album = PhaseCamera(session.plant, console, NO_GRAPHICS_REASON)
        waiting = Spinner(console, f"the planner thinks ({session.planner.name})")
        with interrupt_handler(session.interrupt):
            waiting.start()
            try:
                finished = session.run(_make_observer(console, album, lookout, waiting))
            finally:
                waiting.stop()
        for cut in session.interrupted_runs:
            console.print(f"[yellow]{escape(str(cut))}[/]")
        _print_result(console, finished)
        if as_json:
            print_result(msgspec.json.encode(run_summary(finished.episode, out, finished.earlier_episodes)).decode())
        album.take_snapshot("the end")
        album.close()
        drawn = project_memories(session.memory)
        write_report(out / "report.html", finished.episode, finished.trace, album.snapshots, drawn)
        console.print(f"[dim]report: {out / 'report.html'}[/]")
        if lookout:
            lookout.finish(finished.episode, stay=keep_view_open)
    return exit_code(finished.episode)


def exit_code(episode: Episode) -> ExitCode:
    """What the episode means to a shell: violations outrank everything but an interruption."""
    if episode.outcome.kind in ("aborted", "handed_over"):
        return ExitCode.INTERRUPTED
    if episode.judgement and episode.judgement.violations:
        return ExitCode.VIOLATION
    if episode.outcome.kind in ("rejected", "declined"):
        return ExitCode.REJECTED
    return ExitCode.SUCCESS if is_success(episode) else ExitCode.FAILED_SAFELY


def is_success(episode: Episode) -> bool:
    """The robot says so and, where somebody knows the truth, the truth agrees."""
    truth = episode.judgement.success if episode.judgement else True
    return episode.outcome.kind in ("succeeded", "paused", "slowed") and truth


def run_summary(episode: Episode, out: Path, earlier: Sequence[Episode] = ()) -> dict[str, Any]:
    """The one object that `--json` prints; `earlier` are the tries that did not succeed."""
    outcome = episode.outcome
    last = episode.attempts[-1].verdict if episode.attempts else None
    return {
        "success": is_success(episode),
        "outcome": outcome.kind,
        "reason": outcome.reason,
        "violations": episode.judgement.violations if episode.judgement else [],
        "contract": episode.contract,
        "verdict": last,
        "shots": len(episode.attempts),
        "earlier": [{"outcome": one.outcome.kind, "reason": one.outcome.reason} for one in earlier],
        "delta": outcome.Delta,
        "intervention_frequency": outcome.intervention_frequency,
        "h_min": outcome.h_min,
        "uses": episode.uses,
        "duration": outcome.duration,
        "timings": episode.timings,
        "out": str(out),
    }


def _make_observer(console: Console, album: PhaseCamera, lookout: LiveFeed | None, waiting: Spinner) -> RunObserver:
    def on_event(event: Event) -> None:
        if event.kind == "action":
            waiting.stop()
        if event.kind != "perception":
            style = EVENT_STYLES.get(event.kind, "")
            console.print(f"[dim]{event.t:7.2f} s[/]  [{style or 'default'}]{escape(event.text)}[/]")
        if lookout:
            lookout.on_event(event)

    return RunObserver(on_event, lookout.on_tick if lookout else lambda moment: None, album.on_phase)


def _print_result(console: Console, finished: RunResult) -> None:
    """The last lines: outcome, numbers, memory, where things lie."""
    episode, outcome = finished.episode, finished.episode.outcome
    colour = "green" if is_success(episode) else "yellow"
    console.print(f"[bold {colour}]{outcome.kind}[/]: {escape(outcome.reason)}")
    if outcome.Delta is not None and outcome.h_min is not None:
        console.print(
            f"Δ {outcome.Delta:.4f}, intervened on {outcome.intervention_frequency:.1%} of ticks, "
            f"closest {outcome.h_min * 1000:.1f} mm beyond all margins, {outcome.duration:.1f} s of motion"
        )
    if words := format_timings(episode.timings):
        console.print(words)
    if episode.judgement:
        for violation in episode.judgement.violations:
            console.print(
                f"[red]violation[/] {violation.kind} at {violation.start:.2f} s: {' × '.join(violation.bodies)}"
            )
        console.print(f"simulator truth: {'success' if episode.judgement.success else 'no success'}")
    if episode.uses:
        console.print(f"retrieval utility: {summarize_uses(episode.uses)}")
    console.print(f"[dim]{finished.store_report}[/]")


class _RealTimePacer:
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
