"""The numbers that an instruction states, as bounds of the parameters of skills.

The gate compares a contract with them (`goal_coverage.py`); `with_stated_values` states the same bounds for a decoder.
"""

from __future__ import annotations

from collections.abc import Sequence

from dualbrain.contracts.parameter_domains import ParameterDomain, ParameterDomains
from dualbrain.contracts.registry import SkillRegistry
from dualbrain.contracts.skill_spec import NumberParameter
from dualbrain.grounding.instruction.stated_values import PARAMETER_NAMES, UNITS, StatedValue


def with_stated_values(
    domains: ParameterDomains, values: Sequence[StatedValue], registry: SkillRegistry
) -> ParameterDomains:
    """`domains`, within the numbers that `values` state; a parameter with several stated numbers keeps its domain."""
    bounds: dict[str, tuple[float, float]] = {}
    for value in values:
        if sum(one.parameter == value.parameter for one in values) == 1:
            bounds |= dict.fromkeys(PARAMETER_NAMES[value.parameter], value.bounds)
    found = dict(domains)
    for skill in registry.skills:
        numbers = [one for one in skill.parameters if isinstance(one, NumberParameter) and one.name in bounds]
        if numbers and all(_overlaps(one, bounds[one.name]) for one in numbers):
            parts = found.get(skill.name, (ParameterDomain(),))
            found[skill.name] = tuple(_bounded(part, numbers, bounds) for part in parts)
    return found


def why_out_of_bounds(values: Sequence[StatedValue], registry: SkillRegistry) -> str:
    """Why no skill takes one of `values`, as a clause for people; "" if each is taken by a skill."""
    for value in values:
        names = PARAMETER_NAMES[value.parameter]
        parameters = [
            (skill.name, one)
            for skill in registry.skills
            for one in skill.parameters
            if isinstance(one, NumberParameter) and one.name in names
        ]
        if not parameters:
            return f"it states {value}, and no skill of this robot takes a {value.parameter}"
        if not any(_overlaps(one, value.bounds) for _, one in parameters):
            skill, one = parameters[0]
            unit = UNITS[value.parameter]
            return f"it states {value}, and {skill} takes {one.lower:.3g} to {one.upper:.3g} {unit}"
    return ""


def _overlaps(parameter: NumberParameter, bounds: tuple[float, float]) -> bool:
    return max(parameter.lower, bounds[0]) <= min(parameter.upper, bounds[1])


def _bounded(
    part: ParameterDomain, numbers: Sequence[NumberParameter], bounds: dict[str, tuple[float, float]]
) -> ParameterDomain:
    """`part` within `bounds`; a bound that would leave nothing is left out, so that the gate states the reason."""
    least, most = dict(part.least), dict(part.most)
    for one in numbers:
        low = max(least.get(one.name, one.lower), bounds[one.name][0])
        high = min(most.get(one.name, one.upper), bounds[one.name][1])
        if low <= high:
            least[one.name], most[one.name] = low, high
    return ParameterDomain(part.admitted, least, most)
