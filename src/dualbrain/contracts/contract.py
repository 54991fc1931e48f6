"""A contract as the planner writes it (paper 3.3): c = {id, context, action_sequence}."""

from __future__ import annotations

import msgspec

ParameterValue = float | str
"""What a parameter may be: a plain number in the registered SI unit, or a name (of a choice, an object, a place)."""


class Action(msgspec.Struct, frozen=True):
    """One call (p_k, θ) of a registered skill with its parameters."""

    skill: str
    params: dict[str, ParameterValue]


class Context(msgspec.Struct, frozen=True):
    """The body and registry that the contract was written for."""

    robot: str
    registry: str


class Contract(msgspec.Struct, frozen=True):
    """An ordered sequence of at most eight actions for one robot and one registry."""

    id: str
    context: Context
    action_sequence: tuple[Action, ...]


class ContractHeader(msgspec.Struct, frozen=True, kw_only=True):
    """One shot of one principal: `sequence` rises with every shot; valid in [issued, expires) [s, the gate's clock].

    A contract is good for one acceptance, in its time, for the scene it was made for (`scene_version`).
    """

    sequence: int
    issued: float
    expires: float
    principal: str
    scene_version: int
