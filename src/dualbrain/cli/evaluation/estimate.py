"""dualbrain evaluate --dry-run: the remaining work and an estimate of its duration."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Sequence
from typing import TYPE_CHECKING

import msgspec

from dualbrain.cli.common.console import StderrConsole, print_result

if TYPE_CHECKING:
    from dualbrain.evaluation.planners.factory import PlannerSources
    from dualbrain.evaluation.protocol.suite import Suite
    from dualbrain.evaluation.runner.probe import ProbeTimes
    from dualbrain.evaluation.runner.runner import Runner
    from dualbrain.evaluation.runner.work_units import Stage, WorkUnit

MEASURED, PROBED, ASSUMED = "measured in these results", "measured now", "assumed"
DEFAULT_EPISODE_S = 4.0
"""Assumed wall time of an episode without measurements [s]; this value and the next two are medians on one core."""
DEFAULT_SMALL_MODEL_REQUEST_S, DEFAULT_LARGE_MODEL_REQUEST_S = 2.4, 25.0
"""Assumed time of a request [s] to the model with 135 million parameters, with or without adapter, and to any other."""


def print_estimate(
    runner: Runner, sources: PlannerSources, jobs: int, console: StderrConsole, *, as_json: bool
) -> None:
    """Print the remaining work and its duration.

    The times of an episode and of a request come from the results folder, else from a probe of this machine, else from
    defaults (servers, and planners that are not downloaded).
    """
    from dualbrain.evaluation.runner.probe import ProbeTimes
    from dualbrain.evaluation.runner.runner import STAGES
    from dualbrain.evaluation.runner.work_units import STAGE_TITLES

    left: dict[Stage, int] = {
        stage: sum(unit.n_episodes - unit.done for unit in runner.remaining_units(stage)) for stage in STAGES
    }
    wall_times = [line["wall_s"] for line in runner.read_lines("fly") if not line.get("same_as")]
    episodes, requests = _remaining_workload(runner)
    measured = _measured_request_times(runner)
    complete = bool(wall_times) and measured.keys() >= requests.keys()
    probed = ProbeTimes() if complete else _probe(runner, sources, console)
    episode, basis = _first((_mean(wall_times), MEASURED), (probed.episode_s, PROBED), (DEFAULT_EPISODE_S, ASSUMED))
    found = {
        name: _first(
            (measured.get(name), MEASURED),
            (probed.request_s.get(name), PROBED),
            (default_request_time(name, sources), ASSUMED),
        )
        for name in requests
    }
    seconds, bases = (
        {name: time for name, (time, _) in found.items()},
        {name: basis for name, (_, basis) in found.items()},
    )
    planning = sum(count * seconds[name] for name, count in requests.items())
    hours = {"planning": planning / jobs / 3600.0, "episodes": episode * episodes / jobs / 3600.0}
    for stage, count in left.items():
        console.print(f"{STAGE_TITLES[stage]}: {count} left")
    total = sum(requests.values())
    console.print(f"about {total} planner requests and {episodes} simulated episodes, with those that only measure")
    rates = [f"{episode:.1f} s per episode ({basis})"]
    rates += [f"{seconds[name]:.1f} s per request to {name} ({bases[name]})" for name in requests]
    console.print(
        f"about {hours['planning']:.1f} h of planning and {hours['episodes']:.1f} h of episodes on {jobs} cores, at "
        + ", ".join(rates),
        markup=False,
        soft_wrap=True,
    )
    if as_json:
        estimate = {"left": left, "hours": hours, "episode_s": episode, "request_s": seconds, "basis": basis}
        print_result(msgspec.json.encode(estimate).decode())


def _probe(runner: Runner, sources: PlannerSources, console: StderrConsole) -> ProbeTimes:
    """Measure this machine, with a spinner."""
    from dualbrain.cli.common.spinner import Spinner
    from dualbrain.evaluation.runner.probe import probe

    spinner = Spinner(console, "measuring the speed of this machine")
    spinner.start()
    try:
        return probe(runner.suite, sources, time.perf_counter)
    finally:
        spinner.stop()


def warn_of_single_runs(suite: Suite, console: StderrConsole) -> None:
    """Print the methods with a single run, for which the report can give intervals of rates only."""
    alone = [name for name in suite.methods if suite.n_clusters(name) < 2]
    if alone:
        console.print(
            f"fewer than two runs of {', '.join(alone)}: the report will contain intervals of rates only for them. "
            "Set more seeds and runs in a suite file.",
            markup=False,
            soft_wrap=True,
        )


def default_request_time(planner: str, sources: PlannerSources) -> float:
    """Assumed time of a request to `planner` [s], from the model that answers it."""
    from dualbrain.adaptation.adapters.naming import is_adapter, resolve_folder
    from dualbrain.adaptation.adapters.registry import AdapterRegistry
    from dualbrain.adaptation.adapters.stacking import read_layers
    from dualbrain.evaluation.planners.factory import underlying_planners
    from dualbrain.planner.registry import SMALL_PLANNER

    def model(name: str) -> str:
        adapted = is_adapter(name)
        return read_layers(resolve_folder(name, AdapterRegistry(sources.adapters)))[0].card.base if adapted else name

    return sum(
        DEFAULT_SMALL_MODEL_REQUEST_S if model(name) == SMALL_PLANNER else DEFAULT_LARGE_MODEL_REQUEST_S
        for name in underlying_planners(planner)
    )


def _remaining_workload(runner: Runner) -> tuple[int, dict[str, int]]:
    """Expected number of remaining episodes, and of remaining requests by planner (without planners that get none)."""
    from dualbrain.evaluation.planners.factory import planner_name
    from dualbrain.evaluation.protocol.method import find_method
    from dualbrain.evaluation.runner.runner import STAGES
    from dualbrain.evaluation.runner.workload import compute_workload, distinct_units

    units: defaultdict[str, list[WorkUnit]] = defaultdict(list)
    for stage in STAGES:
        for unit in runner.remaining_units(stage):
            units[planner_name(runner.suite, find_method(unit.method))].append(unit)
    work = {name: compute_workload(runner.suite, distinct_units(runner.suite, some)) for name, some in units.items()}
    return sum(one.episodes for one in work.values()), {
        name: one.requests for name, one in work.items() if one.requests
    }


def _measured_request_times(runner: Runner) -> dict[str, float]:
    """Mean time of a request by planner [s], from the log of the plan pass."""
    from dualbrain.evaluation.planners.factory import planner_name
    from dualbrain.evaluation.protocol.method import find_method

    asked = defaultdict[str, list[float]](list)
    for line in runner.read_lines("plan"):
        if line["asked"]:
            method = find_method(line["key"].partition(" ")[0])
            asked[planner_name(runner.suite, method)].append(line["planner_s"])
    return {name: sum(times) / len(times) for name, times in asked.items()}


def _mean(values: Sequence[float]) -> float | None:
    return sum(values) / len(values) if values else None


def _first(*candidates: tuple[float | None, str]) -> tuple[float, str]:
    """The first of (time [s], basis) that has a time."""
    return next((time, basis) for time, basis in candidates if time is not None)
