"""A control barrier function for the hand alone: dualbrain's filter reduced to it."""

from __future__ import annotations

from collections.abc import Sequence

import msgspec
import numpy as np
from numpy.typing import NDArray

from benchmarks.guards.robot_interface import RobotInterface
from dualbrain.robots.model import RobotModel
from dualbrain.safety.cbf.config import FilterConfig
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.safety.cbf.obstacles import Obstacle

Array = NDArray[np.float64]
HAND_GROUPS = ("hand", "fingers")


class HandFilter:
    """A control barrier function for the hand alone, as AEGIS has for an end effector: the strongest form of it.

    The rows are those of dualbrain's kernel with the true shape of hand and fingers, at 1 kHz, in a box of joint
    velocities and joint ranges; links of the arm, self-collision and limits of acceleration are unknown to it.
    """

    def __init__(
        self, robot_model: RobotModel, obstacles: Sequence[Obstacle], interface: RobotInterface, duration: float
    ) -> None:
        """Guard the hand of an arm at rest at the commanded posture of `interface`."""
        hand = {link.name for link in robot_model.links if link.group in HAND_GROUPS}
        reduced = msgspec.structs.replace(
            robot_model,
            spheres=tuple(sphere for sphere in robot_model.spheres if sphere.link in hand),
            self_pairs=msgspec.structs.replace(robot_model.self_pairs, kept=()),
        )
        config = FilterConfig(acceleration_limits=False)
        self._safety, self._interface = SafetyFilter(reduced, config, obstacles=obstacles), interface
        self._opening, self._duration = float(robot_model.gripper.opening.value), duration
        self._nominal = np.zeros_like(interface.u)

    def begin(self, action: Array, q: Array, now: float) -> None:
        """Take `action` as the target."""
        del q, now
        self._nominal = self._interface.velocity_towards(action, self._duration)

    def velocity(self, q: Array, v: Array, now: float) -> Array:
        """The nearest velocity that keeps the hand away from the obstacles."""
        return self._safety(q, v, self._nominal, now, self._opening).u
