"""Evidence about the end of an episode: the scenes before and after it, joint positions, and the grips of the hand.

All of it is measured by the robot (perception, encoders, finger forces). The judge on simulator truth builds the same
record from exact scenes, so that both compare an instruction by the same rules.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from dualbrain.records import GripProfile, Scene, SceneObject
from dualbrain.robots.model import RobotModel

Array = NDArray[np.float64]

BASE_COORDINATES = 3
"""Leading coordinates of a mobile robot's configuration: x, y, heading."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Evidence:
    """Facts of an episode.

    `q_before`, `q_after` (n,) [rad] are joint positions, `home` the home posture; for a base `base_after` is its (x, y)
    [m]. `executed` are the skills that ran, `placements` the last destination of each object that the contract places,
    `in_hand` the object in the gripper at the end, `in_hand_before` the one in the scene before, `held_at_start` the
    one at the beginning of the contract, which may be a later try. `earlier_grips` are those of the tries before it.
    `touched` are the objects that a finger touches.
    `unsettled` are objects that still move. `broken` are objects that are known to be broken.
    """

    before: Scene
    after: Scene
    q_before: Array
    q_after: Array
    home: Array
    base_after: tuple[float, float] | None = None
    declined: bool = False
    executed: tuple[str, ...] = ()
    placements: dict[str, str] = field(default_factory=dict)
    earlier_grips: tuple[GripProfile, ...] = ()
    grips: tuple[GripProfile, ...] = ()
    in_hand: str = ""
    in_hand_before: str = ""
    held_at_start: str = ""
    touched: frozenset[str] = frozenset()
    unsettled: frozenset[str] = frozenset()
    broken: frozenset[str] = frozenset()

    @property
    def all_grips(self) -> tuple[GripProfile, ...]:
        """The grips since the instruction was given, in their order."""
        return (*self.earlier_grips, *self.grips)

    def object_before(self, name: str) -> SceneObject | None:
        """The object `name` before the episode."""
        return next((obj for obj in self.before.objects if obj.name == name), None)

    def object_after(self, name: str) -> SceneObject | None:
        """The object `name` after the episode."""
        return next((obj for obj in self.after.objects if obj.name == name), None)

    @property
    def kept_in_hand(self) -> str:
        """The object that is in the gripper before and after the episode; "" if there is none."""
        return self.in_hand if self.in_hand == self.in_hand_before else ""

    @property
    def movable_names(self) -> tuple[str, ...]:
        """Objects and containers of the scene before."""
        return tuple(obj.name for obj in self.before.objects if obj.role in ("object", "container"))


def arm_home(robot_model: RobotModel) -> Array:
    """Home posture (n,) [rad] of the arm of `robot_model`; empty for a base without an arm."""
    return np.array(robot_model.home)[BASE_COORDINATES if robot_model.is_mobile else 0 :]


def base_position(robot_model: RobotModel, q: Array) -> tuple[float, float] | None:
    """Position (x, y) [m] of a mobile base with the configuration `q`; None for a fixed arm."""
    return (float(q[0]), float(q[1])) if robot_model.is_mobile else None
