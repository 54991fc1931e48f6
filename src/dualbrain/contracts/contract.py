"""Action contracts as written by the planner (paper 3.3): c = {id, context, action_sequence}."""

from __future__ import annotations

from collections.abc import Mapping

import msgspec

ParameterValue = float | str
"""Value of a parameter: a number in the registered SI unit, or a name (of a choice, an object, a place)."""


class Action(msgspec.Struct, frozen=True):
    """One call (p_k, θ) of a registered skill with its parameters."""

    skill: str
    params: dict[str, ParameterValue]


NAMING_PARAMETERS = ("object", "target", "destination", "place")
"""Parameters whose values are names of the scene."""


def action_in_words(skill: object, params: Mapping[str, object]) -> str:
    """An action as its skill and the names in it, such as "place blue_bowl"."""
    return " ".join((str(skill), *(str(params[key]) for key in NAMING_PARAMETERS if key in params)))


class Context(msgspec.Struct, frozen=True):
    """The robot and the hash of the registry for which the contract was written."""

    robot: str
    registry: str


class Contract(msgspec.Struct, frozen=True):
    """An ordered sequence of at most eight actions for one robot and one registry."""

    id: str
    context: Context
    action_sequence: tuple[Action, ...]


class ContractHeader(msgspec.Struct, frozen=True, kw_only=True):
    """Authorization header of one contract, sent by one principal.

    `sequence` increases with every contract of the principal. A contract can be accepted once, within
    [issued, expires) [s, the gate's clock], and only for the scene of version `scene_version`.
    """

    sequence: int
    issued: float
    expires: float
    principal: str
    scene_version: int
