"""Specification of a skill: name, parameters with units and bounds, and the contacts it needs in each phase."""

from __future__ import annotations

from typing import Literal

import msgspec


class NumberParameter(msgspec.Struct, frozen=True, tag_field="kind", tag="number", kw_only=True):
    """A number in `unit` (coherent SI) in [lower, upper]; `lower_from` and `upper_from` give the provenance."""

    name: str
    unit: str
    lower: float
    upper: float
    lower_from: str
    upper_from: str
    description: str = ""


class ChoiceParameter(msgspec.Struct, frozen=True, tag_field="kind", tag="choice"):
    """One of a fixed list of identifiers."""

    name: str
    choices: tuple[str, ...]
    description: str = ""


class NameParameter(msgspec.Struct, frozen=True, tag_field="kind", tag="name"):
    """The name of an object or place of the scene; `of` selects the names, and the enum is built for each scene."""

    name: str
    of: Literal["graspable", "receptive", "any"]
    description: str = ""


class TextParameter(msgspec.Struct, frozen=True, tag_field="kind", tag="text"):
    """Free text of bounded length, meant for people: no skill may act on it."""

    name: str
    max_length: int
    description: str = ""


Parameter = NumberParameter | ChoiceParameter | NameParameter | TextParameter


class ContactPermit(msgspec.Struct, frozen=True):
    """Permission for one pair to touch in one phase of a skill, with the maximum approach `speed` [m/s].

    `robot_part` is a sphere group of the robot model ("fingers", "hand", "held"); `other` is "target", "destination" or
    "support". Permits come from the skill, never from a contract.
    """

    phase: str
    robot_part: str
    other: Literal["target", "destination", "support"]
    speed: float


class SkillSpec(msgspec.Struct, frozen=True):
    """One primitive p_k of the vocabulary P with its parameter domain (paper 3.3)."""

    name: str
    description: str
    parameters: tuple[Parameter, ...] = ()
    permits: tuple[ContactPermit, ...] = ()
