"""Clauses that the skills of a robot can express, derived from the parameters of its registry."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf
from typing import get_args

from dualbrain.contracts.registry import SkillRegistry
from dualbrain.contracts.skill_spec import NameParameter, NumberParameter, SkillSpec
from dualbrain.grounding.instruction.clauses.rules.clause_rule import Capability

HANDOVER_SKILLS = frozenset({"hand_over", "handover", "give"})
"""Names of skills that would hand an object to a person; no registry has one today."""
UNITS: dict[str, Capability] = {"m/s": "speed", "N": "force"}
"""Units of parameters, and the capability of a robot whose skills take a number with this unit."""
HEADING_PARAMETERS = frozenset({"heading", "angle", "yaw"})


@dataclass(frozen=True, slots=True)
class Capabilities:
    """The capabilities of a registry, and the longest time [s] that one of its skills waits (0.0: none does)."""

    names: frozenset[Capability]
    longest_wait: float


ALL_CAPABILITIES = Capabilities(frozenset(get_args(Capability)) - {""}, inf)
"""What some robot could express."""


def capabilities(registry: SkillRegistry) -> Capabilities:
    """What contracts of `registry` can express beyond a plain sequence."""
    names: set[Capability] = set()
    waits = [_duration(skill) for skill in registry.skills]
    if any(waits):
        names.add("wait")
    kinds = {
        parameter.of
        for skill in registry.skills
        for parameter in skill.parameters
        if isinstance(parameter, NameParameter)
    }
    if {"graspable", "receptive"} <= kinds:  # objects, and containers that hold them
        names.add("occupancy")
    for skill in registry.skills:
        numbers = {parameter.name for parameter in skill.parameters if isinstance(parameter, NumberParameter)}
        units = {parameter.unit for parameter in skill.parameters if isinstance(parameter, NumberParameter)}
        names |= {capability for unit, capability in UNITS.items() if unit in units}
        if "clearance" in numbers:
            names.add("clearance")
        if "distance" in numbers:
            names.add("push distance")
        if numbers & HEADING_PARAMETERS:
            names.add("turn")
        if skill.name in HANDOVER_SKILLS:
            names.add("hand over")
    return Capabilities(frozenset(names), max(waits, default=0.0))


def _duration(skill: SkillSpec) -> float:
    """The upper bound of a parameter `duration` [s] of a skill without names; 0.0 if there is none."""
    if any(isinstance(parameter, NameParameter) for parameter in skill.parameters):
        return 0.0
    found = (
        parameter.upper
        for parameter in skill.parameters
        if isinstance(parameter, NumberParameter) and parameter.unit == "s" and parameter.name == "duration"
    )
    return max(found, default=0.0)
