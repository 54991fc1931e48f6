"""The closed vocabulary of one robot: its skills, their parameters with units and bounds, and the hash of it all."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from dualbrain.contracts.canonical_json import canonical_json
from dualbrain.contracts.skill_spec import Choice, Name, Number, Parameter, SkillSpec, Text
from dualbrain.core.units import require_si
from dualbrain.errors import InvalidSetup, UnknownName

CONTRACT_VERSION = 1
"""Rises when the form or the meaning of a contract changes; part of every registry hash."""

LARGEST_BOUND = 1e9
LONGEST_TEXT = 500
_IDENTIFIER = re.compile(r"[a-z][a-z0-9_]{0,31}")


@dataclass(frozen=True)
class Registry:
    """The skills that `robot` offers (the primitive vocabulary P of paper 3.3); checked once, when it is built.

    Raises `InvalidSetup` for a duplicate or unreadable name, a unit that is not SI, a bound that is not finite, not
    ordered or without provenance, an empty choice.
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
        """Every skill under its name."""
        return {skill.name: skill for skill in self.skills}

    def skill(self, name: str) -> SkillSpec:
        """The skill called `name`; raises `UnknownName`."""
        if name not in self.by_name:
            raise UnknownName("skill", name, tuple(self.by_name), owner=self.robot)
        return self.by_name[name]

    def canonical(self) -> bytes:
        """What the hash is taken of (RFC 8785): contract version, robot, skills, parameters, units, bounds, words.

        Left out: descriptions and provenance, because rewording them changes no contract's meaning and must not make
        memories and adapters foreign; permits, because they come from the skill and are never written in a contract.
        Order is left out too: skills, parameters and words are sets.
        """
        skills = {skill.name: {p.name: _meaning(p) for p in skill.parameters} for skill in self.skills}
        return canonical_json({"contract_version": CONTRACT_VERSION, "robot": self.robot, "skills": skills})

    @cached_property
    def hash(self) -> str:
        """First 8 hex digits of the SHA-256 of `canonical()`: a name for honest mistakes, not a signature."""
        return hashlib.sha256(self.canonical()).hexdigest()[:8]


def _meaning(parameter: Parameter) -> dict[str, Any]:
    """The part of a parameter that gives a contract its meaning."""
    match parameter:
        case Number():
            return {"number": parameter.unit, "lower": parameter.lower, "upper": parameter.upper}
        case Choice():
            return {"choice": sorted(parameter.choices)}
        case Name():
            return {"name": parameter.of}
        case Text():
            return {"text": parameter.max_length}


def _require_identifiers(what: str, names: Iterable[str]) -> None:
    """Raise unless `names` is not empty and holds distinct identifiers."""
    seen: set[str] = set()
    for name in names:
        if not _IDENTIFIER.fullmatch(name):
            raise InvalidSetup(what, got=name[:80], allowed=f"identifiers, {_IDENTIFIER.pattern}")
        if name in seen:
            raise InvalidSetup(what, got=name, allowed="each name once", fix="Rename or drop the duplicate.")
        seen.add(name)
    if not seen:
        raise InvalidSetup(what, got="none", allowed="at least one name")


def _require_skill(skill: SkillSpec) -> None:
    """Raise unless every parameter and permit of `skill` is sane."""
    if skill.parameters:
        _require_identifiers(f"parameters of {skill.name}", [parameter.name for parameter in skill.parameters])
    for parameter in skill.parameters:
        _require_parameter(f"{skill.name}.{parameter.name}", parameter)
    for permit in skill.permits:
        if not 0.0 <= permit.speed <= LARGEST_BOUND:
            raise InvalidSetup(f"permit of {skill.name}", got=permit.speed, allowed="a speed of at least 0 m/s")


def _require_parameter(where: str, parameter: Parameter) -> None:
    """Raise unless the domain of `parameter` is sane."""
    match parameter:
        case Number():
            require_si(parameter.unit)
            _require_bounds(where, parameter)
        case Choice():
            _require_identifiers(f"choices of {where}", parameter.choices)
        case Text():
            if not 1 <= parameter.max_length <= LONGEST_TEXT:
                raise InvalidSetup(f"length of {where}", got=parameter.max_length, allowed=f"1 to {LONGEST_TEXT}")
        case Name():
            pass


def _require_bounds(where: str, number: Number) -> None:
    """Raise unless lower ≤ upper, both finite, and each says where it comes from."""
    if not -LARGEST_BOUND <= number.lower <= number.upper <= LARGEST_BOUND:
        got = f"{number.lower} to {number.upper} {number.unit}"
        raise InvalidSetup(f"bounds of {where}", got=got, allowed=f"lower ≤ upper within ±{LARGEST_BOUND:g}")
    if not (number.lower_from.strip() and number.upper_from.strip()):
        raise InvalidSetup(
            f"provenance of {where}", got="none", allowed="where each bound comes from", fix="Name the source."
        )


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
