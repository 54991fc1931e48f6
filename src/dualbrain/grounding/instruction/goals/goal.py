"""The goal of an instruction: conditions on the scene and on the robot that hold once the instruction is carried out.

A small deterministic parser reads the goal (`read_goal`); it shares no code, data or model with any planner. A sentence
that it does not account for word by word is not read, so that no part of an instruction is left out in silence.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from dualbrain.grounding.instruction.stated_values import StatedValue

Relation = Literal[
    "in",
    "on",
    "at",
    "near",
    "left_of",
    "right_of",
    "in_front_of",
    "behind",
    "between",
    "under",
    "above",
    "away_from",
    "off",
]
"""Relation of an object to a reference. Left and right are those of the robot, as in the names of places."""
Direction = Literal["toward", "away_from", "left", "right", "forward", "backward"]
"""Direction of a push: relative to a reference, or in the frame of the robot (forward: away from the robot)."""
Movement = Literal["still", "home", "rest", "drive"]
"""How the robot ends: without any motion, at rest in its home posture, either of both, or at a place."""
CONTRACT_RELATIONS: tuple[Relation, ...] = ("in", "at", "off")
"""Relations that a contract can state: its destinations are containers ("in"; "off": another one) and places."""


@dataclass(frozen=True, slots=True)
class Placed:
    """`count` of `objects` (None: all of them) are released in `relation` to `references`; "between" has two."""

    objects: tuple[str, ...]
    relation: Relation
    references: tuple[str, ...]
    count: int | None = None


@dataclass(frozen=True, slots=True)
class Held:
    """One of `objects` is in the gripper, above its support; `handed`: it was to be given to a person."""

    objects: tuple[str, ...]
    handed: bool = False


@dataclass(frozen=True, slots=True)
class Pushed:
    """All `objects` have moved in `direction` (of `reference`) and still are on their support."""

    objects: tuple[str, ...]
    direction: Direction
    reference: str = ""


@dataclass(frozen=True, slots=True)
class Unmoved:
    """None of `objects` has moved."""

    objects: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Observed:
    """The empty hand is above `object_name`, which has not moved unless the goal moves it before (`is_moved`)."""

    object_name: str
    is_moved: bool = False


@dataclass(frozen=True, slots=True)
class RobotEnds:
    """The robot ends as `movement` states; `place` is the end of a drive."""

    movement: Movement
    place: str = ""


Condition = Placed | Held | Pushed | Unmoved | Observed | RobotEnds
Step = Condition | Literal["wait"]
"""An action that an instruction asks for, as the condition that it leads to, or a pause."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Goal:
    """All `conditions` hold at the end, and no object except `movable` has moved.

    With `decline`, a reason, the instruction is to be declined; nothing else carries it out. If the reason is a phrase
    that names nothing in the scene, it is `absent`. The groups of `steps` are to be done in their order, the steps of
    one group in any order. On the way the robot waits `pauses` times, and a base visits the places `visits` in this
    order. The numbers of a contract are those of `values`.
    """

    conditions: tuple[Condition, ...] = ()
    decline: str = ""
    absent: str = ""
    movable: frozenset[str] = field(default_factory=frozenset)
    steps: tuple[tuple[Step, ...], ...] = ()
    pauses: int = 0
    visits: tuple[str, ...] = ()
    values: tuple[StatedValue, ...] = ()

    @property
    def beyond_contracts(self) -> str:
        """The first condition that no contract can state, in words; "" if contracts can state all of them."""
        for one in self.conditions:
            if isinstance(one, Placed) and one.relation not in CONTRACT_RELATIONS:
                return f'no contract can state "{one.relation.replace("_", " ")}"'
            if isinstance(one, Held) and one.handed:
                return "no contract can state that a person takes an object"
            if isinstance(one, Pushed) and one.direction != "toward":
                return f'no contract can state a push "{one.direction.replace("_", " ")}"'
        return self.full_hand

    @property
    def full_hand(self) -> str:
        """The first step that would need the hand while it holds an object until the end, in words; "" without one."""
        held: tuple[str, ...] = ()
        for group in self.steps:
            moved = [one for one in group if isinstance(one, Placed | Held | Pushed)]
            for one in moved:
                if held and not set(one.objects) <= set(held):
                    holds, moves = (names[0].replace("_", " ") for names in (held, one.objects))
                    return f"the hand still holds {holds} when it is to move {moves}"
            held = next((one.objects for one in moved if isinstance(one, Held) and one in self.conditions), held)
        return ""

    @property
    def is_home_on_the_way(self) -> bool:
        """Whether the instruction asks the robot to go home before another action."""
        home = RobotEnds("home")
        return home not in self.conditions and any(home in group for group in self.steps)


@dataclass(frozen=True, slots=True)
class Unread:
    """The instruction could not be read; `reason` is a sentence."""

    reason: str
