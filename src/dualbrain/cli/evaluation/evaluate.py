"""dualbrain evaluate: the paper's evaluation protocol, from a suite to a table of episodes."""

from __future__ import annotations

import os
import time
from contextlib import closing
from pathlib import Path
from typing import Annotated, Any

import msgspec
from cyclopts import Parameter

from dualbrain.cli.common.console import Account, answer
from dualbrain.cli.common.exit_codes import Exit
from dualbrain.cli.common.paths import cache, home
from dualbrain.cli.evaluation.results import results, tell_left_out
from dualbrain.cli.evaluation.suite_options import narrowed
from dualbrain.errors import InvalidSetup, MissingPart, WrongUsage

Flag = Annotated[bool, Parameter(negative="")]
BEFORE_ALL = ("pilot", "start")
"""Passes that others cannot do without; an answer that is missing from the plan pass is asked for in flight."""


def evaluate(
    *, suite: str = "smoke", only: Annotated[str, Parameter(name="--methods")] = "",
    episodes: int = 0, robots: str = "", planner: str = "",
    out: Path | None = None, jobs: int = 0, dry_run: Flag = False, plan_only: Flag = False, again: str = "",
    json: Flag = False,
) -> int:  # fmt: skip
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
    from dualbrain.core.storage.resumable_steps import alone
    from dualbrain.evaluation.planners.factory import Sources
    from dualbrain.evaluation.runner.preflight import require_adapters
    from dualbrain.evaluation.runner.runner import STAGES, Runner
    from dualbrain.evaluation.runner.work_units import units_of

    if jobs < 0:
        raise WrongUsage("--jobs", got=jobs, allowed="at least 1, or 0 for all cores")
    if again:
        return _again(out or Path("runs") / f"evaluate-{Path(suite).stem}", again, blind, as_json=json)
    chosen = narrowed(suite, only, episodes, robots, planner)
    folder = out or Path("runs") / f"evaluate-{chosen.name}"
    account = Account()
    runner = Runner(chosen, folder, clock=time.monotonic, tell=lambda progress: account.print(_line(progress)))
    sources = Sources(cache(), home() / "adapters", os.environ.get("OPENAI_API_KEY", ""))
    require_adapters(chosen, (unit for stage in STAGES for unit in units_of(chosen, stage)), sources)
    if dry_run:
        return _dry_run(runner, sources, jobs or os.cpu_count() or 1, account, as_json=json)
    _can_see(chosen.methods, blind)
    with alone(folder, wait=False):
        return _run(runner, sources, jobs or os.cpu_count() or 1, account, plan_only=plan_only, as_json=json)


def _can_see(methods: tuple[str, ...], blind: str) -> None:
    """Raises `MissingPart` if a method has cameras for eyes and nothing here draws what they see."""
    from dualbrain.evaluation.protocol.method import find_method

    seeing = [name for name in methods if find_method(name).eyes == "depth"]
    if seeing and blind:
        from dualbrain.simulation.perception.rendering import INSTALL

        raise MissingPart(f"A GL library for the cameras of {', '.join(seeing)}", fix=f"{INSTALL} ({blind})")


def _run(runner: Any, sources: Any, jobs: int, account: Account, *, plan_only: bool, as_json: bool) -> int:
    from dualbrain.cli.evaluation.estimate import warn_of_single_runs
    from dualbrain.cli.evaluation.results import FLOWN, flown_on
    from dualbrain.evaluation.results.parquet import FILE, write_table
    from dualbrain.evaluation.runner.preflight import require_parts
    from dualbrain.evaluation.runner.runner import CONFIG, STAGES, read_config

    require_parts(runner.suite, (unit for stage in STAGES for unit in runner.left(stage)), sources)
    runner.prepare(*_here(runner.suite))
    warn_of_single_runs(runner.suite, account)
    whole = False
    try:
        whole = _passes(runner, STAGES[:-1] if plan_only else STAGES, sources, jobs)
    except KeyboardInterrupt:
        account.print("nothing that was finished is lost: the same command goes on")
        raise
    finally:  # also after Ctrl-C: what was flown so far can be read
        rows = runner.rows()
        if rows:
            config = read_config(runner.out / CONFIG)
            write_table(rows, config | {FLOWN: flown_on(runner.out, config)}, runner.out / FILE)
    if rows:
        account.print(f"{len(rows)} episodes in {runner.out / FILE}; read them with: dualbrain report {runner.out}")
    if not whole:
        account.print(f"not whole: see {runner.out / 'errors.jsonl'}; the same command tries again")
    if as_json:
        answer(msgspec.json.encode({"out": str(runner.out), "episodes": len(rows), "whole": whole}).decode())
    return Exit.SUCCESS if whole else Exit.FAILED_SAFELY


def _here(suite: Any) -> tuple[Any, Any]:
    """Code and versions that would fly `suite`, and what its adapters took."""
    from dualbrain.evaluation.report.adaptation_cost import costs
    from dualbrain.evaluation.runner.provenance import origin

    return origin(), costs(suite, home() / "adapters", suite.robots[0])


def _passes(runner: Any, stages: Any, sources: Any, jobs: int) -> bool:
    """One pass after another; whether all are over."""
    whole = True
    for stage in stages:
        whole = _stage(runner, stage, sources, jobs) and whole
        if not whole and stage in BEFORE_ALL:
            break
    return whole


def _stage(runner: Any, stage: Any, sources: Any, jobs: int) -> bool:
    """One pass; whether it is over."""
    from dualbrain.evaluation.runner.worker import Workplace
    from dualbrain.evaluation.runner.worker_pool import Alone, Processes

    epsilon = {} if stage == "pilot" else runner.epsilon()
    place = Workplace(runner.suite, runner.out, sources, time.perf_counter, epsilon)
    if jobs > 1:
        return runner.advance(stage, Processes(place.make, jobs))
    with closing(place.make()) as work:
        return runner.advance(stage, Alone(work))


def _dry_run(runner: Any, sources: Any, jobs: int, account: Account, *, as_json: bool) -> int:
    """Say what would be done; raises `InvalidSetup` where the folder could not be gone on with."""
    from dualbrain.cli.evaluation.estimate import estimate, warn_of_single_runs
    from dualbrain.evaluation.runner.runner import CONFIG

    if (runner.out / CONFIG).exists():
        runner.check(*_here(runner.suite))
    estimate(runner, sources, jobs, account, as_json=as_json)
    warn_of_single_runs(runner.suite, account)
    return Exit.SUCCESS


def _again(folder: Path, key: str, blind: str, *, as_json: bool) -> int:
    """One finished episode of the results in `folder` once more, as their own suite has it."""
    from dualbrain.evaluation.analysis.failure_taxonomy import class_of
    from dualbrain.evaluation.episodes.rerun import Watching, again, differs

    flown, _, suite = results(folder, tell_left_out)
    rows = {row.key: row for row in flown}
    if key not in rows:
        some = ", ".join(list(rows)[:3])
        raise InvalidSetup("key of an episode", got=key, allowed=f"one of {len(rows)} in {folder}, such as {some}")
    row = rows[key]
    _can_see((row.method,), blind)
    flight = again(row, suite, time.perf_counter, Watching())
    other = differs(row, flight)
    account = Account()
    for event in flight.trace.events:
        account.print(f"{event.t:7.2f} s  {event.text}", markup=False)
    for violation in flight.episode.judgement.violations if flight.episode.judgement else ():
        account.print(f"violation {violation.kind} at {violation.start:.2f} s: {' × '.join(violation.bodies)}")
    account.print(f"{class_of(row) or 'success'}: {'as recorded' if not other else '; '.join(other)}", markup=False)
    if as_json:
        answer(msgspec.json.encode({"key": key, "same": not other, "differs": other}).decode())
    return Exit.SUCCESS if not other else Exit.FAILED_SAFELY


def _line(progress: Any) -> str:
    """One finished episode for a person."""
    line, left = progress.line, progress.seconds_left
    words = f"{progress.stage} {progress.done}/{progress.total}  {line['key']}"
    if progress.error:
        return f"[red]{words}: {progress.error.splitlines()[0]}[/]"
    if "outcome" in line:
        words += f": {'success' if line['success'] else line['failure']}"
        words += f", Δ {line['Delta']:.4f}" if line["Delta"] is not None else ""
        words += f", {len(line['violations'])} violations" if line["violations"] else ""
    return f"{words}  [dim]{_time(left)} left[/]"


def _time(seconds: float | None) -> str:
    if seconds is None:
        return "?"
    return (
        f"{seconds:.0f} s"
        if seconds < 120
        else f"{seconds / 60:.0f} min"
        if seconds < 7200
        else f"{seconds / 3600:.1f} h"
    )
