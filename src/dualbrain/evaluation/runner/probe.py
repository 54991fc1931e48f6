"""Measurement of this machine before an evaluation: a few episodes and planner requests, in a temporary folder."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import msgspec

from dualbrain.errors import DualbrainError
from dualbrain.evaluation.planners.factory import PLANNER_ROLES, PlannerSources, planner_name
from dualbrain.evaluation.protocol.method import find_method
from dualbrain.evaluation.protocol.suite import Suite
from dualbrain.evaluation.runner.preflight import require_planner_files
from dualbrain.evaluation.runner.work_units import WorkUnit, build_units
from dualbrain.evaluation.runner.worker import Worker, WorkerConfig

TYPICAL_SIMULATED_S = 20.0
"""Mean simulated time of an episode [s]: 17 to 24 s by method in suite `paper`, 16 to 25 s in the other suites."""
MAX_TASKS = 4
"""Tasks of the suite in which an episode is measured."""


@dataclass(frozen=True)
class ProbeTimes:
    """Wall time of a typical episode [s], None if none could be measured, and of a request by planner [s]."""

    episode_s: float | None = None
    request_s: dict[str, float] = field(default_factory=dict)


def probe(suite: Suite, sources: PlannerSources, clock: Callable[[], float]) -> ProbeTimes:
    """Run one episode with a random contract in up to `MAX_TASKS` tasks, and two requests to each local planner.

    A planner whose files are missing, and one behind a server, is not measured. The results are discarded.
    """
    return ProbeTimes(_episode_time(suite, sources, clock), _request_times(suite, sources, clock))


def _episode_time(suite: Suite, sources: PlannerSources, clock: Callable[[], float]) -> float | None:
    """Wall time of an episode of typical length [s], from the wall time per simulated second."""
    scripted = msgspec.structs.replace(suite, planners=dict.fromkeys(PLANNER_ROLES, "template"), bare=0, free=0)
    units = {
        (unit.task.name, unit.robot): unit
        for unit in build_units(scripted, "fly")
        if not find_method(unit.method).uses_memory and find_method(unit.method).perception == "declared"
    }
    with _worker(scripted, sources, clock) as worker:
        rows = [line for unit in _spread(list(units.values())) for line in worker(unit)]
    simulated = sum(row["simulated_s"] for row in rows)
    return TYPICAL_SIMULATED_S * sum(row["wall_s"] for row in rows) / simulated if simulated else None


def _request_times(suite: Suite, sources: PlannerSources, clock: Callable[[], float]) -> dict[str, float]:
    """Time of the second of two requests to each planner [s]; the first one may load the model."""
    found: dict[str, float] = {}
    for unit in build_units(suite, "plan"):
        name = planner_name(suite, find_method(unit.method))
        if name in found or "://" in name:
            continue
        try:
            require_planner_files(name, unit.robot, sources)
            with _worker(suite, sources, clock) as worker:
                times = [line["planner_s"] for one in _single_requests(unit) for line in worker(one) if line["asked"]]
        except DualbrainError:  # the run itself will report it
            continue
        if times:
            found[name] = times[-1]
    return found


@contextmanager
def _worker(suite: Suite, sources: PlannerSources, clock: Callable[[], float]) -> Iterator[Worker]:
    with tempfile.TemporaryDirectory() as folder:
        config = WorkerConfig(suite=suite, out=Path(folder), sources=sources, clock=clock, epsilon={})
        with closing(config.make_worker()) as worker:
            yield worker


def _single_requests(unit: WorkUnit) -> Iterable[WorkUnit]:
    """Two units with one request each, of the same planner."""
    for seed in (unit.seeds * 2)[:2]:
        yield msgspec.structs.replace(unit, seeds=(seed,), repetitions=unit.repetitions[:1])


def _spread(units: list[WorkUnit]) -> list[WorkUnit]:
    """At most `MAX_TASKS` of `units`, evenly spaced."""
    step = max(1, len(units) // MAX_TASKS)
    return units[::step][:MAX_TASKS]
