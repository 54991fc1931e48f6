"""What a skill declares of itself: name, parameters with units and bounds, and the contacts it needs by phase."""

from __future__ import annotations

from typing import Literal

import msgspec


class NumberParameter(msgspec.Struct, frozen=True, tag_field="kind", tag="number", kw_only=True):
    """A number in `unit` (SI, checked by pint) within [lower, upper]; each bound says where it comes from."""

    name: str
    unit: str
    lower: float
    upper: float
    lower_from: str
    upper_from: str
    description: str = ""


class ChoiceParameter(msgspec.Struct, frozen=True, tag_field="kind", tag="choice"):
    """One word of a fixed list."""

    name: str
    choices: tuple[str, ...]
    description: str = ""


class NameParameter(msgspec.Struct, frozen=True, tag_field="kind", tag="name"):
    """The name of something in the scene: `of` says which names are offered; the enum is built per scene."""

    name: str
    of: Literal["graspable", "receptive", "any"]
    description: str = ""


class TextParameter(msgspec.Struct, frozen=True, tag_field="kind", tag="text"):
    """Free text of bounded length (only for people: no skill may act on it)."""

    name: str
    max_length: int
    description: str = ""


Parameter = NumberParameter | ChoiceParameter | NameParameter | TextParameter


class ContactPermit(msgspec.Struct, frozen=True):
    """Which pair may touch in which phase of a skill, and how fast they may approach.

    `robot_part` is a sphere group of the body ("fingers", "hand", "held"); `other` is "target", "destination" or
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
