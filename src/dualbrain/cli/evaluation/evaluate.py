"""dualbrain evaluate: the paper's evaluation protocol, from a suite to a table of episodes."""

from __future__ import annotations

import os
import time
from contextlib import closing
from pathlib import Path
from typing import Annotated, Any

import msgspec
from cyclopts import Parameter

from dualbrain.cli.common.console import StderrConsole, print_result
from dualbrain.cli.common.exit_codes import ExitCode
from dualbrain.cli.common.paths import cache_folder, dualbrain_home
from dualbrain.cli.evaluation.results import load_results, print_omission
from dualbrain.cli.evaluation.suite_options import override_suite
from dualbrain.errors import ConfigurationError, MissingDependencyError, UsageError

Flag = Annotated[bool, Parameter(negative="")]
REQUIRED_STAGES = ("pilot", "start")
"""Passes that others cannot do without; an answer that is missing from the plan pass is asked for in flight."""


def evaluate(
    *,
    suite: str = "smoke",
    methods: Annotated[str, Parameter(name="--methods")] = "",
    episodes: int = 0,
    robots: str = "",
    planner: str = "",
    out: Path | None = None,
    jobs: int = 0,
    dry_run: Flag = False,
    plan_only: Flag = False,
    again: str = "",
    json: Flag = False,
) -> int:
    """Compare methods by the paper's protocol, resumably.

    Parameters
    ----------
    suite
        Name of a suite that comes with dualbrain (smoke, first, paper, cross, scenes, large, ablations, refusals,
        attacks, eyes) or a TOML file.
    only
        Only these, as B1,B2,B3 (also G, B4, M, P, PE, Full, the adversary's A1-A3, B3-depth, B1-free, and the
        ablations). More of them may be flown into the same --out later.
    episodes
        Episodes of each method in each task (a family at a level) on each robot, instead of the suite's: as many scenes
        as that takes, openly told.
    robots
        Only these robots, as panda,ur5e.
    planner
        Ask this planner in place of the suite's base: a name of `dualbrain models list`, adapter:ID, a URL, or
        `template`. Other parts by name: base=base-135m,adapted=adapter:ID.
    out
        Folder of results; default runs/evaluate-SUITE. What is there already is not flown again.
    jobs
        Processes; default: all cores.
    dry_run
        Only say what would be flown and about how long it would take.
    plan_only
        Stop after the planner's answers: they can be asked where there is a GPU, and flown elsewhere.
    again
        Fly one finished episode of the results in --out again by its key, as the report names it, and say whether it
        came out the same. The suite is that of the results.
    json
        Print one JSON object on stdout.
    """
    from dualbrain.cli.common.graphics import choose_graphics

    blind = choose_graphics(os.environ)  # before MuJoCo is imported, here and in every worker
    from dualbrain.core.storage.resumable_steps import exclusive_folder
    from dualbrain.evaluation.planners.factory import PlannerSources
    from dualbrain.evaluation.runner.preflight import require_adapters
    from dualbrain.evaluation.runner.runner import STAGES, Runner
    from dualbrain.evaluation.runner.work_units import build_units

    if jobs < 0:
        raise UsageError("--jobs", got=jobs, allowed="at least 1, or 0 for all cores")
    if again:
        return _rerun(out or Path("runs") / f"evaluate-{Path(suite).stem}", again, blind, as_json=json)
    chosen = override_suite(suite, methods, episodes, robots, planner)
    folder = out or Path("runs") / f"evaluate-{chosen.name}"
    account = StderrConsole()
    runner = Runner(
        chosen, folder, clock=time.monotonic, on_progress=lambda progress: account.print(_format_progress(progress))
    )
    sources = PlannerSources(cache_folder(), dualbrain_home() / "adapters", os.environ.get("OPENAI_API_KEY", ""))
    require_adapters(chosen, (unit for stage in STAGES for unit in build_units(chosen, stage)), sources)
    if dry_run:
        return _dry_run(runner, sources, jobs or os.cpu_count() or 1, account, as_json=json)
    _require_rendering(chosen.methods, blind)
    with exclusive_folder(folder, wait=False):
        return _run(runner, sources, jobs or os.cpu_count() or 1, account, plan_only=plan_only, as_json=json)


def _require_rendering(methods: tuple[str, ...], blind: str) -> None:
    """Raises `MissingPart` if a method has cameras for eyes and nothing here draws what they see."""
    from dualbrain.evaluation.protocol.method import find_method

    seeing = [name for name in methods if find_method(name).perception == "depth"]
    if seeing and blind:
        from dualbrain.simulation.perception.rendering import INSTALL_HINT

        raise MissingDependencyError(
            f"A GL library for the cameras of {', '.join(seeing)}", fix=f"{INSTALL_HINT} ({blind})"
        )


def _run(runner: Any, sources: Any, jobs: int, account: StderrConsole, *, plan_only: bool, as_json: bool) -> int:
    from dualbrain.cli.evaluation.estimate import warn_of_single_runs
    from dualbrain.cli.evaluation.results import RUN_DATE_KEY, last_run_date
    from dualbrain.evaluation.results.parquet import RESULTS_FILE, write_results
    from dualbrain.evaluation.runner.preflight import require_dependencies
    from dualbrain.evaluation.runner.runner import CONFIG_FILE, STAGES, read_config

    require_dependencies(runner.suite, (unit for stage in STAGES for unit in runner.left(stage)), sources)
    runner.prepare(*_provenance_and_costs(runner.suite))
    warn_of_single_runs(runner.suite, account)
    whole = False
    try:
        whole = _run_stages(runner, STAGES[:-1] if plan_only else STAGES, sources, jobs)
    except KeyboardInterrupt:
        account.print("nothing that was finished is lost: the same command goes on")
        raise
    finally:  # also after Ctrl-C: what was flown so far can be read
        rows = runner.rows()
        if rows:
            config = read_config(runner.out / CONFIG_FILE)
            write_results(rows, config | {RUN_DATE_KEY: last_run_date(runner.out, config)}, runner.out / RESULTS_FILE)
    if rows:
        account.print(
            f"{len(rows)} episodes in {runner.out / RESULTS_FILE}; read them with: dualbrain report {runner.out}"
        )
    if not whole:
        account.print(f"not whole: see {runner.out / 'errors.jsonl'}; the same command tries again")
    if as_json:
        print_result(msgspec.json.encode({"out": str(runner.out), "episodes": len(rows), "whole": whole}).decode())
    return ExitCode.SUCCESS if whole else ExitCode.FAILED_SAFELY


def _provenance_and_costs(suite: Any) -> tuple[Any, Any]:
    """Code and versions that would fly `suite`, and what its adapters took."""
    from dualbrain.evaluation.report.adaptation_cost import adapter_costs
    from dualbrain.evaluation.runner.provenance import collect_provenance

    return collect_provenance(), adapter_costs(suite, dualbrain_home() / "adapters", suite.robots[0])


def _run_stages(runner: Any, stages: Any, sources: Any, jobs: int) -> bool:
    """One pass after another; whether all are over."""
    whole = True
    for stage in stages:
        whole = _run_stage(runner, stage, sources, jobs) and whole
        if not whole and stage in REQUIRED_STAGES:
            break
    return whole


def _run_stage(runner: Any, stage: Any, sources: Any, jobs: int) -> bool:
    """One pass; whether it is over."""
    from dualbrain.evaluation.runner.worker import WorkerConfig
    from dualbrain.evaluation.runner.worker_pool import ProcessPool, SerialPool

    epsilon = {} if stage == "pilot" else runner.epsilon()
    place = WorkerConfig(suite=runner.suite, out=runner.out, sources=sources, clock=time.perf_counter, epsilon=epsilon)
    if jobs > 1:
        return runner.advance(stage, ProcessPool(place.make_worker, jobs))
    with closing(place.make_worker()) as work:
        return runner.advance(stage, SerialPool(work))


def _dry_run(runner: Any, sources: Any, jobs: int, account: StderrConsole, *, as_json: bool) -> int:
    """Say what would be done; raises `InvalidSetup` where the folder could not be gone on with."""
    from dualbrain.cli.evaluation.estimate import print_estimate, warn_of_single_runs
    from dualbrain.evaluation.runner.runner import CONFIG_FILE

    if (runner.out / CONFIG_FILE).exists():
        runner.check(*_provenance_and_costs(runner.suite))
    print_estimate(runner, sources, jobs, account, as_json=as_json)
    warn_of_single_runs(runner.suite, account)
    return ExitCode.SUCCESS


def _rerun(folder: Path, key: str, blind: str, *, as_json: bool) -> int:
    """One finished episode of the results in `folder` once more, as their own suite has it."""
    from dualbrain.evaluation.analysis.failure_taxonomy import failure_class_of
    from dualbrain.evaluation.episodes.rerun import RerunHooks, find_differences, rerun_episode

    flown, _, suite = load_results(folder, print_omission)
    rows = {row.key: row for row in flown}
    if key not in rows:
        some = ", ".join(list(rows)[:3])
        raise ConfigurationError(
            "key of an episode", got=key, allowed=f"one of {len(rows)} in {folder}, such as {some}"
        )
    row = rows[key]
    _require_rendering((row.method,), blind)
    flight = rerun_episode(row, suite, time.perf_counter, RerunHooks())
    other = find_differences(row, flight)
    account = StderrConsole()
    for event in flight.trace.events:
        account.print(f"{event.t:7.2f} s  {event.text}", markup=False)
    for violation in flight.episode.judgement.violations if flight.episode.judgement else ():
        account.print(f"violation {violation.kind} at {violation.start:.2f} s: {' × '.join(violation.bodies)}")
    account.print(
        f"{failure_class_of(row) or 'success'}: {'as recorded' if not other else '; '.join(other)}", markup=False
    )
    if as_json:
        print_result(msgspec.json.encode({"key": key, "same": not other, "differs": other}).decode())
    return ExitCode.SUCCESS if not other else ExitCode.FAILED_SAFELY


def _format_progress(progress: Any) -> str:
    """One finished episode for a person."""
    line, left = progress.line, progress.seconds_left
    words = f"{progress.stage} {progress.done}/{progress.total}  {line['key']}"
    if progress.error:
        return f"[red]{words}: {progress.error.splitlines()[0]}[/]"
    if "outcome" in line:
        words += f": {'success' if line['success'] else line['failure']}"
        words += f", Δ {line['Delta']:.4f}" if line["Delta"] is not None else ""
        words += f", {len(line['violations'])} violations" if line["violations"] else ""
    return f"{words}  [dim]{_format_duration(left)} left[/]"


def _format_duration(seconds: float | None) -> str:
    if seconds is None:
        return "?"
    return (
        f"{seconds:.0f} s"
        if seconds < 120
        else f"{seconds / 60:.0f} min"
        if seconds < 7200
        else f"{seconds / 3600:.1f} h"
    )
