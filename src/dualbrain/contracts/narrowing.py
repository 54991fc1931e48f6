"""Whether one vocabulary only narrows another: the same words, within the same bounds or tighter ones."""

from __future__ import annotations

from dualbrain.contracts.registry import Registry
from dualbrain.contracts.skill_spec import Choice, Name, Number, Parameter, SkillSpec, Text


def narrows(inner: Registry, outer: Registry) -> bool:
    """Whether `inner` differs from `outer` at most by tighter bounds: same robot, skills, parameters, units, choices.

    Promise: every value that `inner` admits `outer` admits too, and means the same there.
    """
    alike = inner.robot == outer.robot and inner.by_name.keys() == outer.by_name.keys()
    return alike and all(_skill(skill, outer.by_name[name]) for name, skill in inner.by_name.items())


def _skill(inner: SkillSpec, outer: SkillSpec) -> bool:
    ours = {parameter.name: parameter for parameter in inner.parameters}
    theirs = {parameter.name: parameter for parameter in outer.parameters}
    return ours.keys() == theirs.keys() and all(_parameter(one, theirs[name]) for name, one in ours.items())


def _parameter(inner: Parameter, outer: Parameter) -> bool:
    match inner, outer:
        case Number(), Number():
            inside = outer.lower <= inner.lower and inner.upper <= outer.upper
            return inner.unit == outer.unit and inside
        case Choice(), Choice():
            return set(inner.choices) == set(outer.choices)
        case Name(), Name():
            return inner.of == outer.of
        case Text(), Text():
            return inner.max_length <= outer.max_length
        case _:
            return False
