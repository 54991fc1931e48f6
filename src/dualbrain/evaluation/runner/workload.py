"""How much is left to do: flights, and questions to a planner, also those that are asked in flight."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from dualbrain.adaptation.serving.open_planner import unbinds
from dualbrain.evaluation.planners.factory import DRAWN, planner_name
from dualbrain.evaluation.protocol.method import Method, find_method
from dualbrain.evaluation.protocol.suite import Suite, is_due
from dualbrain.evaluation.runner.work_units import Unit
from dualbrain.planner.prompt.full_prompt import MAX_RECALLED


@dataclass(frozen=True, slots=True)
class Effort:
    """At most so many: doors that decide nothing share a flight, and equal questions an answer."""

    flights: int
    questions: int


def effort(suite: Suite, units: Iterable[Unit]) -> Effort:
    """What `units` of any pass ask for; the flights of a pilot and of a common ledger count like others."""
    found = [_of_unit(suite, unit) for unit in units]
    return Effort(sum(one.flights for one in found), sum(one.questions for one in found))


def _of_unit(suite: Suite, unit: Unit) -> Effort:
    method = find_method(unit.method)
    left = [repetition for _, repetition in list(unit.order)[unit.done :]]
    speaks = planner_name(suite, method) not in DRAWN
    if unit.stage == "plan":
        return Effort(0, len(left))
    asked = len(left) * (unit.stage == "pilot") * speaks
    if unit.stage != "fly":
        return Effort(len(left), asked)
    bare = sum(is_due(suite.bare, k) for k in left) * method.guard
    return Effort(len(left) + bare, sum(_questions(suite, method, k) for k in left) * speaks)


def _questions(suite: Suite, method: Method, repetition: int) -> int:
    """Of one flight: with memory its own, and one without each memory where that is due; and the free one."""
    free = is_due(suite.free, repetition) and unbinds(planner_name(suite, method))
    if not method.remembers:
        return int(free)
    return 1 + free + MAX_RECALLED * is_due(suite.memory.utility, repetition)
