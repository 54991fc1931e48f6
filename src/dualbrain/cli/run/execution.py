"""Execution of a run for a person: progress on stderr, a JSON summary on stdout, the report in the run folder."""

# ruff: noqa: E402  (the GL library is chosen before MuJoCo is imported)
from __future__ import annotations

import os
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import msgspec
from rich.console import Console
from rich.markup import escape

from dualbrain.cli.common.answer_display import AnswerDisplay
from dualbrain.cli.common.console import StderrConsole, print_result
from dualbrain.cli.common.exit_codes import ExitCode
from dualbrain.cli.common.graphics import choose_graphics
from dualbrain.cli.common.planner_choice import choose_planner
from dualbrain.cli.common.planner_threads import planner_threads

NO_GRAPHICS_REASON = choose_graphics(os.environ)  # before MuJoCo is imported

from dualbrain.cli.common.running_gatekeepers import REGISTRATIONS
from dualbrain.cli.common.signals import interrupt_handler
from dualbrain.cli.common.spinner import Spinner
from dualbrain.cli.run.live_feed import LiveFeed
from dualbrain.cli.run.snapshots import PhaseCamera
from dualbrain.cli.run.stop_command import listen_for_stop
from dualbrain.control.control_loop import TickSnapshot
from dualbrain.control.recording.trace import Event
from dualbrain.core.paths import dualbrain_home
from dualbrain.core.processes.real_time_pacer import RealTimePacer
from dualbrain.core.text import storable_text
from dualbrain.grounding.outcome.outcome_check import COMPLETED
from dualbrain.knowledge.library import has_site_documents
from dualbrain.memory.maintenance.projection import project_memories
from dualbrain.memory.plasticity.retrieval_utility import summarize_uses
from dualbrain.planner.introspection import no_documents_reason
from dualbrain.planner.protocol import show_answers
from dualbrain.records import Episode
from dualbrain.runtime.backends.gatekeeper import GatekeeperBackend
from dualbrain.runtime.planning.planning_time import format_timings
from dualbrain.runtime.session import Clocks, RunConfig, RunObserver, RunResult, Session
from dualbrain.safety.supervisor.checks import CHECKS
from dualbrain.visualization.html.run_report import FILTER_OFF_NOTICE, write_report

EVENT_STYLES = {
    "verdict": "bold cyan",
    "action": "bold",
    "phase": "dim",
    "intervention": "yellow",
    "takeover": "red",
    "order": "yellow",
    "operator": "magenta",
}

CHECK_DESCRIPTIONS = {one.name: one.description for one in CHECKS}
PACE_TOLERANCE_S, MIN_SLEEP_S = 0.2, 0.004
"""Deviation from real time after which the live view starts again from the present, and the shortest pause [s]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RunView:
    """How a run is shown, and whether it runs in real time.

    `live_view`: open the live view on `port`; `keep_open`: keep it open at the end. `as_json`: print one JSON object on
    stdout. `real_time`: run behind a gatekeeper process, beginning at the speed scale `speed_scale`.
    """

    live_view: bool = True
    keep_open: bool = False
    port: int = 8080
    as_json: bool = False
    real_time: bool = False
    speed_scale: float = 1.0


def execute_run(config: RunConfig, view: RunView, loading: Spinner | None = None) -> ExitCode:
    """Run the configured instruction, print its progress, and write the report; returns the exit code.

    `loading` is a spinner that is visible already; it stops when all resources are open.
    """
    console = StderrConsole()
    backend = make_backend(view)
    with ExitStack() as stack:
        with loading or Spinner(console, "loading"):
            name, notice = choose_planner(config.planner, config.robot, config.cache)
            threads = planner_threads(control_loop=view.real_time or view.live_view)
            config = replace(config, planner=name, planner_threads=threads)
            session = stack.enter_context(Session(config, make_clocks(view), os.environ, backend=backend))
        if notice and config.contract is None:
            console.print(f"[yellow]{escape(notice)}[/]")
        print_title(console, session)
        feed = open_live_feed(session, backend, view, console) if view.live_view else None
        with interrupt_handler(session.interrupt):
            listen_for_stop(session.instruct, lambda words: console.print(f"[yellow]{escape(words)}[/]"))
            result, report = run_session(session, backend, console, feed)
        if view.as_json:
            summary = run_summary(result.episode, config.out, result.earlier_episodes)
            print_result(msgspec.json.encode(summary).decode())
        report()
        if feed:
            feed.finish(result.episode, stay=view.keep_open)
    return exit_code(result.episode)


def make_backend(view: RunView) -> GatekeeperBackend | None:
    """The gatekeeper of a run in real time; None for the simulator of this process."""
    registrations = dualbrain_home() / REGISTRATIONS
    return GatekeeperBackend(view.speed_scale, registrations=registrations) if view.real_time else None


def open_live_feed(session: Session, backend: GatekeeperBackend | None, view: RunView, console: Console) -> LiveFeed:
    """Open the live view of a run."""
    instruction, operate = session.config.instruction, backend.operate if backend else None
    model, plant = session.robot_model, session.plant
    return LiveFeed(model, plant, view.port, console, instruction=instruction, operate=operate)


def make_clocks(view: RunView) -> Clocks:
    """The clocks of one run; a live view paces the simulation of this process to real time."""
    pace = RealTimePacer(tolerance=PACE_TOLERANCE_S, min_sleep=MIN_SLEEP_S) if view.live_view else None
    return Clocks(time.monotonic, datetime.now(UTC).isoformat(timespec="seconds"), time.time, pace)


def print_title(console: Console, session: Session) -> None:
    """Print the instruction with robot, scene and run folder, and every option that changes the run."""
    config = session.config
    title = escape(storable_text(config.instruction, 400)) or "a given contract"
    where = f"continues {config.after}" if config.after else f"scene {config.scene}"
    console.print(f"[bold]{title}[/]  [dim]{escape(f'{config.robot}, {where}, {config.out}')}[/]")
    if not config.guard:
        console.print(f"[bold yellow]{FILTER_OFF_NOTICE}[/]")
    if _has_documents_to_read(config) and (reason := no_documents_reason(session.planner)):
        console.print(f"[yellow]{escape(reason)}[/]")


def _has_documents_to_read(config: RunConfig) -> bool:
    """Whether a person expects that documents are read: those that were asked for, or those that the site has."""
    if config.contract is not None or config.knowledge is None:
        return False
    return config.consult == "on" or (config.consult == "site" and has_site_documents(config.knowledge))


def run_session(
    session: Session, backend: GatekeeperBackend | None, console: Console, feed: LiveFeed | None
) -> tuple[RunResult, Callable[[], None]]:
    """Run a session and print its progress and its result; the returned function writes the report."""
    if backend is not None:
        backend.on_tick_report = feed.on_tick_report if feed else None
        backend.on_reports_end = feed.end_reports if feed else None
    camera = PhaseCamera(session.plant, console, NO_GRAPHICS_REASON)
    with Spinner(console, f"planning ({session.planner.name})") as spinner:
        show_answers(session.planner, AnswerDisplay(spinner))
        result = session.run(_make_observer(console, camera, feed, spinner))
    for notice in (*session.ledger.notices, *session.interrupted_runs):
        console.print(f"[yellow]{escape(str(notice))}[/]")
    _print_result(console, result)

    def report() -> None:
        camera.take_snapshot("end of the run")
        camera.close()
        path = session.config.out / "report.html"
        memories = project_memories(session.memory)
        write_report(path, result.episode, result.trace, camera.snapshots, memories, result.earlier_episodes)
        console.print(f"[dim]report: {escape(str(path))}[/]")

    return result, report


def exit_code(episode: Episode) -> ExitCode:
    """The exit code of an episode; a violation has priority over every other result except an interruption."""
    if episode.outcome.kind in ("aborted", "handed_over"):
        return ExitCode.INTERRUPTED
    if episode.judgement and episode.judgement.violations:
        return ExitCode.VIOLATION
    if episode.outcome.kind in ("rejected", "declined"):
        return ExitCode.REJECTED
    if is_success(episode):
        return ExitCode.SUCCESS
    return ExitCode.NOT_JUDGED if is_not_judged(episode) else ExitCode.FAILED_SAFELY


def is_success(episode: Episode) -> bool:
    """Whether the instruction was carried out: the contract ended as planned, and that is confirmed.

    Ground truth confirms it where it judged the instruction; otherwise the independent senses of the robot do.
    """
    if episode.outcome.kind not in COMPLETED:
        return False
    if episode.judgement and episode.judgement.judged:
        return episode.judgement.success
    return episode.second_opinion == "agrees"


def is_not_judged(episode: Episode) -> bool:
    """Whether a contract ended as planned, and nothing decides whether the instruction was carried out."""
    judged = episode.judgement is not None and episode.judgement.judged
    return episode.outcome.kind in COMPLETED and not judged and episode.second_opinion == "none"


def describe_end(episode: Episode) -> str:
    """The outcome in words; a completed contract is called a success only if the instruction was carried out."""
    if episode.outcome.kind not in COMPLETED or is_success(episode):
        return episode.outcome.kind
    return f"contract completed, instruction {'not judged' if is_not_judged(episode) else 'not carried out'}"


def describe_judgement(episode: Episode) -> str:
    """The judgement of the instruction as one line: by ground truth, else by the senses of the robot."""
    judgement = episode.judgement
    if judgement is not None:
        verdict = ("success" if judgement.success else "no success") if judgement.judged else "not judged"
        return f"simulator ground truth: {verdict}{f' ({judgement.reason})' if judgement.reason else ''}"
    words = {"agrees": "confirmed", "disagrees": "contradicted", "none": "not judged"}
    return f"independent senses: {words[episode.second_opinion]}"


def run_summary(episode: Episode, out: Path, earlier: Sequence[Episode] = ()) -> dict[str, Any]:
    """The JSON object that `--json` prints; `earlier` are the tries that did not succeed."""
    outcome = episode.outcome
    last = episode.attempts[-1].verdict if episode.attempts else None
    return {
        "success": is_success(episode),
        "judged": not is_not_judged(episode),
        "judgement": describe_judgement(episode),
        "senses": episode.senses,
        "changes": episode.changes,
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


def _make_observer(console: Console, camera: PhaseCamera, feed: LiveFeed | None, spinner: Spinner) -> RunObserver:
    def on_event(event: Event) -> None:
        if event.kind == "action":
            spinner.stop()
        if event.kind != "perception":
            style = EVENT_STYLES.get(event.kind, "")
            console.print(f"[dim]{event.t:7.2f} s[/]  [{style or 'default'}]{escape(_event_text(event))}[/]")
        if feed:
            feed.on_event(event)

    def on_tick(moment: TickSnapshot) -> None:
        camera.on_tick(moment)
        if feed:
            feed.on_tick(moment)

    if feed is None:
        return RunObserver(on_event, on_tick, camera.on_phase)
    return RunObserver(on_event, on_tick, camera.on_phase, feed.on_attempt)


def _event_text(event: Event) -> str:
    """The text of an event: a check is described in words, and a phase that is called like its skill is named once."""
    first, _, second = event.text.partition(": ")
    match event.kind:
        case "phase" if first == second:
            return first
        case "order" if second in CHECK_DESCRIPTIONS:
            return f"{first}: {CHECK_DESCRIPTIONS[second]} ({second})"
        case _:
            return event.text


def _print_result(console: Console, result: RunResult) -> None:
    """Print outcome, measurements, times, violations, the judgement of the simulator, and changes of memory."""
    episode, outcome = result.episode, result.episode.outcome
    colour = "green" if is_success(episode) else "yellow"
    end = describe_end(episode)
    console.print(f"[bold {colour}]{end}[/]: {escape(outcome.reason.removeprefix(f'{end}: '))}")
    if outcome.Delta is not None and outcome.h_min is not None:
        console.print(
            f"Δ {outcome.Delta:.4f}, intervention on {outcome.intervention_frequency:.1%} of ticks, "
            f"minimum clearance {outcome.h_min * 1000:.1f} mm beyond all margins, {outcome.duration:.1f} s of motion"
        )
    if words := format_timings(episode.timings):
        console.print(words)
    if episode.judgement:
        for violation in episode.judgement.violations:
            bodies = escape(" × ".join(violation.bodies))
            console.print(f"[red]violation[/] {violation.kind} at {violation.start:.2f} s: {bodies}")
    console.print(escape(describe_judgement(episode)))
    moved = episode.contract is not None and episode.outcome.kind != "declined"
    for one in episode.senses if moved else ():
        console.print(f"[dim]sense {one.sense}: {one.verdict}: {escape(one.reason)}[/]")
    if is_not_judged(episode):
        console.print("[yellow]It was not judged whether the instruction was carried out.[/]")
    if episode.uses:
        console.print(f"retrieval utility: {summarize_uses(episode.uses)}", markup=False)
    console.print(f"[dim]{escape(str(result.store_report))}[/]")
