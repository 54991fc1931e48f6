"""dualbrain evaluate: run the evaluation protocol of the paper, from a suite to a table of episodes."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import msgspec
from cyclopts import Parameter
from rich.markup import escape

from dualbrain.cli.common.console import StderrConsole, print_result
from dualbrain.cli.common.exit_codes import ExitCode
from dualbrain.cli.evaluation.merge import merge_results
from dualbrain.cli.evaluation.results import load_results, print_omission, write_table
from dualbrain.cli.evaluation.suite_options import override_suite
from dualbrain.core.paths import cache_folder, dualbrain_home
from dualbrain.errors import ConfigurationError, MissingDependencyError, UsageError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from dualbrain.evaluation.planners.factory import PlannerSources
    from dualbrain.evaluation.protocol.suite import Suite
    from dualbrain.evaluation.runner.runner import Runner, Stage
    from dualbrain.evaluation.runner.worker import WorkerConfig

Flag = Annotated[bool, Parameter(negative="")]
HiddenDefault = Annotated[int, Parameter(show_default=False)]
"""A number whose default 0 has the meaning that its help states."""
WorkerPlace = Literal["processes", "ray"]
INHERITED_VARIABLES = ("MUJOCO_GL", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS")
"""Environment variables that workers on other machines take over, if they are set here."""
MAX_ROUNDS = 3
"""Most rounds of a pass on a Ray cluster: units of a worker that died are run again in the next one."""
REQUIRED_STAGES = ("pilot", "start")
"""Passes that later passes depend on. An answer that the plan pass did not get is requested during the episode."""


def evaluate(
    *,
    suite: str = "smoke",
    methods: Annotated[str, Parameter(name="--methods")] = "",
    episodes: HiddenDefault = 0,
    robots: str = "",
    planner: str = "",
    target: str = "",
    out: Path | None = None,
    jobs: HiddenDefault = 0,
    pool: WorkerPlace = "processes",
    dry_run: Flag = False,
    prepare_only: Flag = False,
    plan_only: Flag = False,
    part: str = "",
    merge: Flag = False,
    again: str = "",
    json: Flag = False,
) -> int:
    """Run the evaluation protocol of the paper; an interrupted evaluation can be resumed.

    Parameters
    ----------
    suite
        Name of a built-in suite (smoke, paper, cross, scenes, embodiments, large, ablations, adaptation, reuse,
        refusals, attacks, eyes), or a TOML file.
    methods
        Only these methods, for example B1,B2,B3. Also available: G, B4, M, M-reuse, P, PE, PE-fixed, V, Full, the
        adversarial A1-A3, B3-depth, B1-free, and the ablations. Further methods can be added to the same --out later.
    episodes
        Number of episodes of each method in each task (a family at a level) on each robot, instead of the suite's. The
        number of scenes follows from it.
    robots
        Only these robots, for example panda,ur5e.
    planner
        Use this planner instead of the suite's base planner: a name of `dualbrain models list`, adapter:ID, a URL, or
        `template`. Set other roles by name: base=base-135m,adapted=adapter:ID.
    target
        Run the filter of every guarded method on an emulated board too (an386, an500 or an505), in lockstep.
    out
        Folder of the results; default runs/evaluate-SUITE. Episodes that it already contains are not run again.
    jobs
        Number of processes; default: all cores, or all CPUs of the Ray cluster.
    pool
        processes: processes of this machine. ray: workers on a running Ray cluster with token authentication, found by
        RAY_ADDRESS or on this machine; all nodes must share the folder --out. See docs/how-to/evaluate.md.
    dry_run
        Only print the remaining work and an estimate of its duration.
    prepare_only
        Stop before the plan pass: only ε and the ledgers from which all methods with memory start, which parts take
        over.
    plan_only
        Stop after the plan pass. Its answers can be computed on a machine with a GPU, and the episodes run elsewhere.
    part
        Run only part K/N of the evaluation, for example 3/16, into its own folder inside --out: one job of an array on
        a cluster. A part is all methods on some of the runs.
    merge
        Merge the parts inside --out into --out, which can then be reported or resumed like any other results.
    again
        Run one finished episode of the results in --out again, by the key that the report prints, and compare it with
        the recorded one. The suite is that of the results.
    json
        Print one JSON object on stdout.
    """
    from dualbrain.cli.common.graphics import choose_graphics

    no_rendering = choose_graphics(os.environ)  # before MuJoCo is imported, here and in every worker
    from dualbrain.core.storage.resumable_steps import exclusive_folder
    from dualbrain.evaluation.planners.factory import PlannerSources
    from dualbrain.evaluation.runner.parts.part import Part
    from dualbrain.evaluation.runner.preflight import require_adapters
    from dualbrain.evaluation.runner.runner import STAGES, Runner

    if jobs < 0:
        raise UsageError("--jobs", got=jobs, allowed="at least 1, or 0 for all cores")
    flags = {"--merge": merge, "--again": again, "--part": part, "--prepare-only": prepare_only}
    if len(given := [name for name, value in flags.items() if value]) > 1:
        raise UsageError("options", got=" ".join(given), allowed="only one of them")
    results = out or Path("runs") / f"evaluate-{Path(suite).stem}"
    if merge:
        return merge_results(results, StderrConsole(), as_json=json)
    if again:
        return _rerun(results, again, no_rendering, as_json=json)
    console = StderrConsole()
    on_left_out = partial(_print_left_out, console) if dry_run else None
    chosen = override_suite(suite, methods, episodes, robots, planner, target=target, on_left_out=on_left_out)
    whole = Runner(
        chosen,
        out or Path("runs") / f"evaluate-{chosen.name}",
        clock=time.monotonic,
        on_progress=lambda progress: console.print(_format_progress(progress)),
    )
    runner = whole.select_part(Part.parse(part, chosen)) if part else whole
    sources = PlannerSources(cache_folder(), dualbrain_home() / "adapters", os.environ.get("OPENAI_API_KEY", ""))
    require_adapters(chosen, (unit for stage in STAGES for unit in runner.units(stage)), sources)
    if dry_run:
        return _dry_run(runner, sources, jobs or os.cpu_count() or 1, console, as_json=json)
    _require_rendering(chosen.methods, no_rendering)
    stages = STAGES[:2] if prepare_only else STAGES[:3] if plan_only else STAGES
    with _open_place(pool) as (on_ray, n_cpus), exclusive_folder(runner.out, wait=False):
        if part:
            _prepare_part(whole, runner, console)
        return _run(runner, stages, sources, Workers(jobs or n_cpus, on_ray=on_ray), console, as_json=json)


@dataclass(frozen=True, slots=True)
class Workers:
    """Number of workers, and whether they run on the connected Ray cluster."""

    jobs: int
    on_ray: bool = False


@contextmanager
def _open_place(pool: WorkerPlace) -> Iterator[tuple[bool, int]]:
    """The place of the workers while the body runs: whether it is a Ray cluster, and its number of CPUs."""
    if pool == "processes":
        yield False, os.cpu_count() or 1
        return
    from dualbrain.evaluation.runner.ray_cluster.connection import connected

    with connected(os.environ, Path.home()) as n_cpus:
        yield True, n_cpus


def _prepare_part(whole: Runner, part: Runner, console: StderrConsole) -> None:
    """Take over the preparation in the folder of the whole evaluation; raises if it has another configuration."""
    from dualbrain.evaluation.runner.parts.preparation import take_over_preparation
    from dualbrain.evaluation.runner.runner import CONFIG_FILE

    if (whole.out / CONFIG_FILE).is_file():
        whole.check_config(*_provenance_and_costs(whole.suite))
    if take_over_preparation(whole, part):
        console.print(f"pilot episodes and start ledgers taken over from {whole.out}", markup=False, soft_wrap=True)


def _require_rendering(methods: tuple[str, ...], no_rendering: str) -> None:
    """Raise `MissingDependencyError` if a method uses depth cameras and this machine cannot render.

    `no_rendering` is the reason why rendering is not available, "" if it is available.
    """
    from dualbrain.evaluation.protocol.method import find_method

    with_cameras = [name for name in methods if find_method(name).perception == "depth"]
    if with_cameras and no_rendering:
        from dualbrain.simulation.perception.rendering import INSTALL_HINT

        raise MissingDependencyError(
            f"A GL library for the cameras of {', '.join(with_cameras)}", fix=f"{INSTALL_HINT} ({no_rendering})"
        )


def _run(
    runner: Runner,
    stages: Sequence[Stage],
    sources: PlannerSources,
    workers: Workers,
    console: StderrConsole,
    *,
    as_json: bool,
) -> int:
    from dualbrain.cli.evaluation.estimate import warn_of_single_runs
    from dualbrain.evaluation.results.parquet import RESULTS_FILE
    from dualbrain.evaluation.runner.preflight import require_dependencies
    from dualbrain.evaluation.runner.runner import CONFIG_FILE, STAGES

    require_dependencies(runner.suite, (unit for stage in STAGES for unit in runner.remaining_units(stage)), sources)
    runner.write_config(*_provenance_and_costs(runner.suite))
    if workers.on_ray:
        from dualbrain.evaluation.runner.ray_cluster.connection import check_nodes

        check_nodes((runner.out / CONFIG_FILE).resolve())
    warn_of_single_runs(runner.suite, console)
    complete = False
    try:
        complete = _run_stages(runner, stages, sources, workers)
    except KeyboardInterrupt:
        console.print("all finished episodes are stored; the same command resumes the evaluation")
        raise
    finally:  # also after Ctrl-C, so that the finished episodes can be read
        n_rows = write_table(runner)
    if n_rows:
        following = (
            f"dualbrain evaluate --merge --out {runner.out.parent} joins it with the other parts"
            if runner.part
            else f"make the report with: dualbrain report {runner.out}"
        )
        console.print(f"{n_rows} episodes in {runner.out / RESULTS_FILE}; {following}", markup=False, soft_wrap=True)
    if not complete:
        console.print(
            f"incomplete: see {runner.out / 'errors.jsonl'}; the same command retries the failed episodes", markup=False
        )
    if as_json:
        print_result(msgspec.json.encode({"out": str(runner.out), "episodes": n_rows, "whole": complete}).decode())
    return ExitCode.SUCCESS if complete else ExitCode.FAILED_SAFELY


def _provenance_and_costs(suite: Suite) -> tuple[Any, Any]:
    """Provenance of this installation, and the cost of the adapters of `suite`."""
    from dualbrain.evaluation.report.adaptation_cost import adapter_costs
    from dualbrain.evaluation.runner.provenance import collect_provenance

    return collect_provenance(), adapter_costs(suite, dualbrain_home() / "adapters", suite.robots[0])


def _run_stages(runner: Runner, stages: Sequence[Stage], sources: PlannerSources, workers: Workers) -> bool:
    """Run the passes in their order; whether all are complete."""
    whole = True
    for stage in stages:
        whole = _run_stage(runner, stage, sources, workers) and whole
        if not whole and stage in REQUIRED_STAGES:
            break
    return whole


def _run_stage(runner: Runner, stage: Stage, sources: PlannerSources, workers: Workers) -> bool:
    """Run one pass; whether it is complete."""
    from dualbrain.evaluation.runner.worker import WorkerConfig
    from dualbrain.evaluation.runner.worker_pool import ProcessPool, SerialPool

    epsilon = {} if stage == "pilot" else runner.epsilon()
    out = runner.out.resolve()  # a worker on a cluster has another working directory
    config = WorkerConfig(suite=runner.suite, out=out, sources=sources, clock=time.perf_counter, epsilon=epsilon)
    if workers.on_ray:
        return _run_stage_on_ray(runner, stage, config, workers.jobs)
    if workers.jobs > 1:
        return runner.run_stage(stage, ProcessPool(config.make_worker, workers.jobs))
    with closing(config.make_worker()) as worker:
        return runner.run_stage(stage, SerialPool(worker))


def _run_stage_on_ray(runner: Runner, stage: Stage, config: WorkerConfig, jobs: int) -> bool:
    """Run one pass on the connected cluster, again after the death of workers; whether it is complete."""
    from dualbrain.evaluation.runner.ray_cluster.pool import RayPool

    environment = {name: os.environ[name] for name in INHERITED_VARIABLES if name in os.environ}
    pool = RayPool(config.make_worker, jobs, environment=environment)
    for _ in range(MAX_ROUNDS):
        if runner.run_stage(stage, pool) or not pool.lost_workers:
            break
    return not runner.remaining_units(stage)


def _print_left_out(console: StderrConsole, methods: tuple[str, ...]) -> None:
    """Print the methods that a dry run leaves out, because the suite names no planner for their role."""
    if methods:
        console.print(
            f"not included: {', '.join(methods)}, which need an adapted planner. Train one with `dualbrain adapt`, or "
            "reproduce those of the suites with `python -m experiments suite_adapters`, and name it with --planner "
            "adapted=adapter:ID.",
            markup=False,
            soft_wrap=True,
        )


def _dry_run(runner: Runner, sources: PlannerSources, jobs: int, console: StderrConsole, *, as_json: bool) -> int:
    """Print the remaining work; raises `ConfigurationError` if the results folder cannot be resumed."""
    from dualbrain.cli.evaluation.estimate import print_estimate, warn_of_single_runs
    from dualbrain.evaluation.runner.runner import CONFIG_FILE

    if (runner.out / CONFIG_FILE).exists():
        runner.check_config(*_provenance_and_costs(runner.suite))
    print_estimate(runner, sources, jobs, console, as_json=as_json)
    warn_of_single_runs(runner.suite, console)
    return ExitCode.SUCCESS


def _rerun(folder: Path, key: str, no_rendering: str, *, as_json: bool) -> int:
    """Run one finished episode of the results in `folder` again, with the suite of the results."""
    from dualbrain.evaluation.analysis.failure_taxonomy import failure_class_of
    from dualbrain.evaluation.episodes.rerun import RerunHooks, find_differences, rerun_episode

    recorded, _, suite = load_results(folder, print_omission)
    rows = {row.key: row for row in recorded}
    if key not in rows:
        some = ", ".join(list(rows)[:3])
        raise ConfigurationError.stating(
            f"{folder} contains no episode with the key {key!r}.", fix=f"It contains {len(rows)} keys, such as {some}."
        )
    row = rows[key]
    _require_rendering((row.method,), no_rendering)
    run = rerun_episode(row, suite, time.perf_counter, RerunHooks())
    differences = find_differences(row, run)
    console = StderrConsole()
    for event in run.trace.events:
        console.print(f"{event.t:7.2f} s  {event.text}", markup=False)
    for violation in run.episode.judgement.violations if run.episode.judgement else ():
        bodies = " × ".join(violation.bodies)
        console.print(f"violation {violation.kind} at {violation.start:.2f} s: {bodies}", markup=False)
    result = "; ".join(differences) if differences else "as recorded"
    console.print(f"{failure_class_of(row) or 'success'}: {result}", markup=False)
    if as_json:
        print_result(msgspec.json.encode({"key": key, "same": not differences, "differs": differences}).decode())
    return ExitCode.FAILED_SAFELY if differences else ExitCode.SUCCESS


def _format_progress(progress: Any) -> str:
    """One line about a finished episode."""
    from dualbrain.evaluation.runner.work_units import STAGE_TITLES

    line, left = progress.line, progress.seconds_left
    words = f"{STAGE_TITLES[progress.stage]} {progress.done}/{progress.total}  {line['key']}"
    if progress.error:
        return f"[red]{escape(f'{words}: {progress.error.splitlines()[0]}')}[/]"
    if "outcome" in line:
        words += f": {'success' if line['success'] else line['failure']}"
        words += f", Δ {line['Delta']:.4f}" if line["Delta"] is not None else ""
        words += f", {len(line['violations'])} violations" if line["violations"] else ""
    return f"{escape(words)}  [dim]{_format_duration(left)} left[/]"


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
