"""Skill registry: the closed vocabulary of one robot, with units and bounds of all parameters, and its hash."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from dualbrain.contracts.canonical_json import canonical_json
from dualbrain.contracts.skill_spec import (
    ChoiceParameter,
    NameParameter,
    NumberParameter,
    Parameter,
    SkillSpec,
    TextParameter,
)
from dualbrain.core.units import require_si
from dualbrain.errors import ConfigurationError, UnknownNameError

CONTRACT_VERSION = 1
"""Increases when the format or the meaning of a contract changes; part of every registry hash."""

MAX_BOUND = 1e9
MAX_TEXT_LENGTH = 500
_IDENTIFIER_PATTERN = re.compile(r"[a-z][a-z0-9_]{0,31}")


@dataclass(frozen=True)
class SkillRegistry:
    """The skills that `robot` offers (the primitive vocabulary P of paper 3.3), checked when the registry is built.

    Raises:
        ConfigurationError: A name is a duplicate or not an identifier, a unit is not SI, a bound is not finite, not
            ordered or without provenance, or a choice is empty.
    """

    robot: str
    skills: tuple[SkillSpec, ...]

    def __post_init__(self) -> None:
        _require_identifiers("robot", [self.robot])
        _require_identifiers("skills of the registry", [skill.name for skill in self.skills])
        for skill in self.skills:
            _require_skill(skill)

    @cached_property
    def by_name(self) -> dict[str, SkillSpec]:
        """The skills by name."""
        return {skill.name: skill for skill in self.skills}

    def skill(self, name: str) -> SkillSpec:
        """The skill called `name`; raises `UnknownNameError`."""
        if name not in self.by_name:
            raise UnknownNameError("skill", name, tuple(self.by_name), owner=self.robot)
        return self.by_name[name]

    def canonical_bytes(self) -> bytes:
        """The hashed content in RFC 8785 form: contract version, robot, skills, parameters, units, bounds, choices.

        Descriptions and provenance are not hashed: a new wording changes the meaning of no contract and must not
        invalidate memories and adapters. Contact permits are not hashed, because a contract never contains them. The
        order of skills, parameters and choices is not hashed either.
        """
        skills = {skill.name: {p.name: _hashed_domain(p) for p in skill.parameters} for skill in self.skills}
        return canonical_json({"contract_version": CONTRACT_VERSION, "robot": self.robot, "skills": skills})

    @cached_property
    def hash(self) -> str:
        """First 8 hex digits of the SHA-256 of `canonical_bytes()`; it detects mistakes, and is not a signature."""
        return hashlib.sha256(self.canonical_bytes()).hexdigest()[:8]


def _hashed_domain(parameter: Parameter) -> dict[str, Any]:
    """The part of a parameter's domain that enters the hash."""
    match parameter:
        case NumberParameter():
            return {"number": parameter.unit, "lower": parameter.lower, "upper": parameter.upper}
        case ChoiceParameter():
            return {"choice": sorted(parameter.choices)}
        case NameParameter():
            return {"name": parameter.of}
        case TextParameter():
            return {"text": parameter.max_length}


def _require_identifiers(what: str, names: Iterable[str]) -> None:
    """Raise unless `names` is not empty and contains distinct identifiers."""
    seen: set[str] = set()
    for name in names:
        if not _IDENTIFIER_PATTERN.fullmatch(name):
            raise ConfigurationError(what, got=name[:80], allowed=f"identifiers, {_IDENTIFIER_PATTERN.pattern}")
        if name in seen:
            raise ConfigurationError(what, got=name, allowed="each name once", fix="Rename or drop the duplicate.")
        seen.add(name)
    if not seen:
        raise ConfigurationError(what, got="none", allowed="at least one name")


def _require_skill(skill: SkillSpec) -> None:
    """Raise unless every parameter and contact permit of `skill` is valid."""
    if skill.parameters:
        _require_identifiers(f"parameters of {skill.name}", [parameter.name for parameter in skill.parameters])
    for parameter in skill.parameters:
        _require_parameter(f"{skill.name}.{parameter.name}", parameter)
    for permit in skill.permits:
        if not 0.0 <= permit.speed <= MAX_BOUND:
            raise ConfigurationError(f"permit of {skill.name}", got=permit.speed, allowed="a speed of at least 0 m/s")


def _require_parameter(where: str, parameter: Parameter) -> None:
    """Raise unless the domain of `parameter` is valid."""
    match parameter:
        case NumberParameter():
            require_si(parameter.unit)
            _require_bounds(where, parameter)
        case ChoiceParameter():
            _require_identifiers(f"choices of {where}", parameter.choices)
        case TextParameter():
            if not 1 <= parameter.max_length <= MAX_TEXT_LENGTH:
                raise ConfigurationError(
                    f"length of {where}", got=parameter.max_length, allowed=f"1 to {MAX_TEXT_LENGTH}"
                )
        case NameParameter():
            pass


def _require_bounds(where: str, number: NumberParameter) -> None:
    """Raise unless lower ≤ upper, both bounds are finite, and both have a provenance."""
    if not -MAX_BOUND <= number.lower <= number.upper <= MAX_BOUND:
        got = f"{number.lower} to {number.upper} {number.unit}"
        raise ConfigurationError(f"bounds of {where}", got=got, allowed=f"lower ≤ upper within ±{MAX_BOUND:g}")
    if not (number.lower_from.strip() and number.upper_from.strip()):
        raise ConfigurationError.stating(
            f"A bound of {where} has no provenance.", fix="Name the source of each bound in lower_from and upper_from."
        )


def is_narrower(inner: SkillRegistry, outer: SkillRegistry) -> bool:
    """Whether `inner` differs from `outer` at most by tighter bounds: same robot, skills, parameters, units, choices.

    Promise: every value that `inner` allows is allowed by `outer` and has the same meaning there.
    """
    same_skills = inner.robot == outer.robot and inner.by_name.keys() == outer.by_name.keys()
    return same_skills and all(_is_narrower_skill(skill, outer.by_name[name]) for name, skill in inner.by_name.items())


def _is_narrower_skill(inner: SkillSpec, outer: SkillSpec) -> bool:
    inner_by_name = {parameter.name: parameter for parameter in inner.parameters}
    outer_by_name = {parameter.name: parameter for parameter in outer.parameters}
    return inner_by_name.keys() == outer_by_name.keys() and all(
        _is_narrower_parameter(parameter, outer_by_name[name]) for name, parameter in inner_by_name.items()
    )


def _is_narrower_parameter(inner: Parameter, outer: Parameter) -> bool:
    match inner, outer:
        case NumberParameter(), NumberParameter():
            within = outer.lower <= inner.lower and inner.upper <= outer.upper
            return inner.unit == outer.unit and within
        case ChoiceParameter(), ChoiceParameter():
            return set(inner.choices) == set(outer.choices)
        case NameParameter(), NameParameter():
            return inner.of == outer.of
        case TextParameter(), TextParameter():
            return inner.max_length <= outer.max_length
        case _:
            return False
