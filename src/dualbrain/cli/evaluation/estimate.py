"""dualbrain evaluate --dry-run: what is left to do, and about how long it takes."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from typing import Any

import msgspec

from dualbrain.cli.common.console import StderrConsole, print_result

DEFAULT_EPISODE_S = 4.0
"""Wall time of an episode that nobody has measured yet [s]; this guess and the next two are medians on one core."""
DEFAULT_SMALL_MODEL_REQUEST_S, DEFAULT_LARGE_MODEL_REQUEST_S = 2.4, 25.0
"""And of a question to the model of 135 million parameters, bare or with an adapter, and to any other."""


def print_estimate(runner: Any, sources: Any, jobs: int, console: StderrConsole, *, as_json: bool) -> None:
    """Say what would be done, and how long it would take by what was measured here, else by a guess that says so."""
    from dualbrain.evaluation.runner.runner import STAGES

    left = {stage: sum(unit.count - unit.done for unit in runner.left(stage)) for stage in STAGES}
    flown = [0.0 if line.get("same_as") else line["wall_s"] for line in runner.lines("fly")]
    episode, basis = _mean(flown) if flown else DEFAULT_EPISODE_S, "measured here" if flown else "a guess"
    flights, questions = _remaining_workload(runner)
    measured = _measured_request_times(runner)
    seconds = {name: measured[name] if name in measured else default_request_time(name, sources) for name in questions}
    planning = sum(count * seconds[name] for name, count in questions.items())
    hours = {"planning": planning / jobs / 3600.0, "flying": episode * flights / jobs / 3600.0}
    for stage, count in left.items():
        console.print(f"{stage}: {count} episodes left")
    console.print(f"at most {sum(questions.values())} questions and {flights} flights, with those that only measure")
    told = [f"{episode:.1f} s an episode ({basis})"]
    told += [
        f"{seconds[name]:.1f} s a question to {name} ({'measured here' if name in measured else 'a guess'})"
        for name in questions
    ]
    console.print(
        f"about {hours['planning']:.1f} h of planning and {hours['flying']:.1f} h of flying on {jobs} cores, at "
        + ", ".join(told),
        markup=False,
        soft_wrap=True,
    )
    if as_json:
        found = {"left": left, "hours": hours, "episode_s": episode, "question_s": seconds, "basis": basis}
        print_result(msgspec.json.encode(found).decode())


def warn_of_single_runs(suite: Any, console: StderrConsole) -> None:
    """Say of which methods the report will have no intervals, because all that they fly is one run."""
    alone = [name for name in suite.methods if suite.clusters(name) < 2]
    if alone:
        console.print(
            f"fewer than two runs of {', '.join(alone)}: the report will have no interval of anything but shares; "
            "state more seeds and runs in a suite file",
            markup=False,
            soft_wrap=True,
        )


def default_request_time(planner: str, sources: Any) -> float:
    """About how long the planner called `planner` takes for an answer [s]: by the model that answers in the end."""
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


def _remaining_workload(runner: Any) -> tuple[int, dict[str, int]]:
    """Flights that are left, and questions by planner, of which any are."""
    from dualbrain.evaluation.planners.factory import planner_name
    from dualbrain.evaluation.protocol.method import find_method
    from dualbrain.evaluation.runner.runner import STAGES
    from dualbrain.evaluation.runner.workload import compute_workload

    units = defaultdict[str, list[Any]](list)
    for stage in STAGES:
        for unit in runner.left(stage):
            units[planner_name(runner.suite, find_method(unit.method))].append(unit)
    work = {name: compute_workload(runner.suite, some) for name, some in units.items()}
    return sum(one.episodes for one in work.values()), {
        name: one.requests for name, one in work.items() if one.requests
    }


def _measured_request_times(runner: Any) -> dict[str, float]:
    """By planner: the mean time of a question that was asked here [s]."""
    from dualbrain.evaluation.planners.factory import planner_name
    from dualbrain.evaluation.protocol.method import find_method

    asked = defaultdict[str, list[float]](list)
    for line in runner.lines("plan"):
        if line["asked"]:
            method = find_method(line["key"].partition(" ")[0])
            asked[planner_name(runner.suite, method)].append(line["planner_s"])
    return {name: _mean(times) for name, times in asked.items()}


def _mean(values: Sequence[float]) -> float:
    return sum(values) / len(values)
