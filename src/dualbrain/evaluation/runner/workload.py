"""Remaining workload: episodes, and planner requests, including those made during an episode."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from dualbrain.adaptation.serving.open_planner import can_be_unconstrained
from dualbrain.evaluation.planners.factory import RANDOM_PLANNERS, planner_name
from dualbrain.evaluation.protocol.method import Method, find_method
from dualbrain.evaluation.protocol.suite import Suite, is_due
from dualbrain.evaluation.runner.work_units import WorkUnit
from dualbrain.planner.prompt.full_prompt import MAX_RECALLED


@dataclass(frozen=True, slots=True)
class Workload:
    """Upper bounds: methods whose gates decide alike share an episode, and equal requests share an answer."""

    episodes: int
    requests: int


def compute_workload(suite: Suite, units: Iterable[WorkUnit]) -> Workload:
    """The workload of `units` of any stage; pilot episodes and those of the start ledger count like others."""
    found = [_unit_workload(suite, unit) for unit in units]
    return Workload(sum(one.episodes for one in found), sum(one.requests for one in found))


def distinct_units(suite: Suite, units: Iterable[WorkUnit]) -> list[WorkUnit]:
    """`units` without those whose episode another method has too: methods without memory that differ in the gate only.

    A planner that is constrained to the schema rarely gives the gates a reason to decide differently.
    """
    found: dict[object, WorkUnit] = {}
    for unit in units:
        method = find_method(unit.method)
        shared = (method.planner_role, method.prompt_corruption, method.constrained, method.guard)
        place = (unit.stage, unit.robot, unit.task.name, unit.seeds, unit.repetitions, method.perception)
        alone = unit.stage != "fly" or method.uses_memory
        found.setdefault(unit.key if alone else (*shared, *place), unit)
    return list(found.values())


def _unit_workload(suite: Suite, unit: WorkUnit) -> Workload:
    method = find_method(unit.method)
    left = [repetition for _, repetition in list(unit.seed_repetition_pairs)[unit.done :]]
    uses_model = planner_name(suite, method) not in RANDOM_PLANNERS
    if unit.stage == "plan":
        return Workload(0, len(left))
    requests = len(left) * (unit.stage == "pilot") * uses_model
    if unit.stage != "fly":
        return Workload(len(left), requests)
    bare = sum(is_due(suite.bare, k) for k in left) * method.guard
    return Workload(len(left) + bare, sum(_requests_per_episode(suite, method, k) for k in left) * uses_model)


def _requests_per_episode(suite: Suite, method: Method, repetition: int) -> int:
    """Requests of one episode: its own and the counterfactuals if memory is used, and the unconstrained one if due."""
    free = is_due(suite.free, repetition) and can_be_unconstrained(planner_name(suite, method))
    if not method.uses_memory:
        return int(free)
    return 1 + free + MAX_RECALLED * is_due(suite.memory.utility, repetition)
