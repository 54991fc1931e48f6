"""dualbrain evaluate: the paper's evaluation protocol, from a suite to a table of episodes."""

from __future__ import annotations

import os
import time
from contextlib import closing
from pathlib import Path
from typing import Annotated, Any

import msgspec
from cyclopts import Parameter

from dualbrain.cli.console import Account, answer
from dualbrain.cli.exits import Exit
from dualbrain.cli.folders import cache, home
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
    from dualbrain.cli.graphics import choose_graphics

    blind = choose_graphics(os.environ)  # before MuJoCo is imported, here and in every worker
    from dualbrain.evaluation.parts import require_adapters
    from dualbrain.evaluation.planners import Sources
    from dualbrain.evaluation.runner import STAGES, Runner
    from dualbrain.evaluation.unit import units_of
    from dualbrain.runtime.steps import alone

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
    from dualbrain.evaluation.method import find_method

    seeing = [name for name in methods if find_method(name).eyes == "depth"]
    if seeing and blind:
        from dualbrain.world.pictures import INSTALL

        raise MissingPart(f"A GL library for the cameras of {', '.join(seeing)}", fix=f"{INSTALL} ({blind})")


def narrowed(suite: str, methods: str, episodes: int, robots: str, planner: str) -> Any:
    """The suite with what the command line changes of it, checked again."""
    from dualbrain.evaluation.planners import check_planners
    from dualbrain.evaluation.suite import check_suite, open_suite

    found, changes = open_suite(suite), dict[str, Any]()
    if methods:
        changes["methods"] = _listed("--methods", methods)
    if robots:
        changes |= _flown_by(found, _listed("--robots", robots))
    if planner:
        changes["planners"] = found.planners | _parts(planner)
    if episodes < 0:
        raise WrongUsage("--episodes", got=episodes, allowed="at least 1")
    if episodes:
        seeds = -(-episodes // found.repetitions)
        changes |= {"seeds": seeds, "runs": min(found.runs, seeds)}
    found = msgspec.structs.replace(found, **changes)
    check_suite(found)
    check_planners(found)
    return found


def _listed(option: str, names: str) -> tuple[str, ...]:
    """Names between commas; raises `WrongUsage` if one of them is empty."""
    found = tuple(name.strip() for name in names.split(","))
    if not all(found):
        raise WrongUsage(option, got=names, allowed="names with a comma between two of them")
    return found


def _flown_by(suite: Any, robots: tuple[str, ...]) -> dict[str, Any]:
    """The suite's tasks that one of `robots` can have, for these alone; raises `InvalidSetup` if there are none."""
    alone = msgspec.structs.replace(suite, robots=robots)
    own = (msgspec.structs.replace(one, robots=tuple(r for r in one.robots if r in robots)) for one in suite.tasks)
    kept = [
        new
        for old, new in zip(suite.tasks, own, strict=True)
        if bool(old.robots) == bool(new.robots) and alone.robots_of(new)
    ]
    if not kept:
        have = [f"{task.name}: {', '.join(_robots_for(task))}" for task in suite.tasks]
        raise InvalidSetup(f"robots of suite {suite.name}", got=", ".join(robots), allowed="; ".join(have))
    return {"robots": robots, "tasks": tuple(kept)}


def _robots_for(task: Any) -> tuple[str, ...]:
    """The robots that can have `task`: those that it names, or all shipped ones whose family it is of."""
    from dualbrain.embodiment.body import BODIES
    from dualbrain.world.families import families_of

    return task.robots or tuple(name for name in BODIES if task.family in families_of(name))


def _parts(planner: str) -> dict[str, str]:
    """By part: its planner. A name alone is the base. Raises `WrongUsage` if one is missing or a part named twice."""
    pairs = [one.partition("=") for one in _listed("--planner", planner)]
    named = [(part.strip(), name.strip()) if sign else ("base", part) for part, sign, name in pairs]
    if not all(name for _, name in named) or len(dict(named)) < len(named):
        raise WrongUsage("--planner", got=planner, allowed="each part once, with its planner, as PART=PLANNER")
    return dict(named)


def _run(runner: Any, sources: Any, jobs: int, account: Account, *, plan_only: bool, as_json: bool) -> int:
    from dualbrain.cli.estimate import warn_of_single_runs
    from dualbrain.cli.report import FLOWN, flown_on
    from dualbrain.evaluation.parts import require_parts
    from dualbrain.evaluation.runner import CONFIG, STAGES, read_config
    from dualbrain.evaluation.table_file import FILE, write_table

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
    from dualbrain.evaluation.cost import costs
    from dualbrain.evaluation.origin import origin

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
    from dualbrain.evaluation.crew import Alone, Processes
    from dualbrain.evaluation.work import Workplace

    epsilon = {} if stage == "pilot" else runner.epsilon()
    place = Workplace(runner.suite, runner.out, sources, time.perf_counter, epsilon)
    if jobs > 1:
        return runner.advance(stage, Processes(place.make, jobs))
    with closing(place.make()) as work:
        return runner.advance(stage, Alone(work))


def _dry_run(runner: Any, sources: Any, jobs: int, account: Account, *, as_json: bool) -> int:
    """Say what would be done; raises `InvalidSetup` where the folder could not be gone on with."""
    from dualbrain.cli.estimate import estimate, warn_of_single_runs
    from dualbrain.evaluation.runner import CONFIG

    if (runner.out / CONFIG).exists():
        runner.check(*_here(runner.suite))
    estimate(runner, sources, jobs, account, as_json=as_json)
    warn_of_single_runs(runner.suite, account)
    return Exit.SUCCESS


def _again(folder: Path, key: str, blind: str, *, as_json: bool) -> int:
    """One finished episode of the results in `folder` once more, as their own suite has it."""
    from dualbrain.cli.report import results, tell_left_out
    from dualbrain.evaluation.again import Watching, again, differs
    from dualbrain.evaluation.failure import class_of

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
