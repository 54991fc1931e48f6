"""dualbrain's `PolicyGuard` at 1 kHz, with both ways to deviate."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from benchmarks.guards.robot_interface import RobotInterface
from dualbrain.robots.model import RobotModel
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.safety.cbf.obstacles import Obstacle
from dualbrain.safety.integration.policy_guard.guard import Deviation, PolicyGuard
from dualbrain.safety.integration.policy_guard.joint_actions import JointPosition

Array = NDArray[np.float64]


class DualbrainGuard:
    """The whole arm behind `PolicyGuard`."""

    def __init__(
        self,
        robot_model: RobotModel,
        obstacles: Sequence[Obstacle],
        interface: RobotInterface,
        duration: float,
        deviation: Deviation = "nearest",
    ) -> None:
        """Guard an arm at rest at the commanded posture of `interface`."""
        safety = SafetyFilter(robot_model, obstacles=obstacles)
        self._opening = float(robot_model.gripper.opening.value)
        self._guard = PolicyGuard(safety, JointPosition(), period=duration, deviation=deviation)
        self._guard.reset(interface.commanded)

    def begin(self, action: Array, q: Array, now: float) -> None:
        """Begin `action`."""
        del q
        self._guard.begin(action, now)

    def velocity(self, q: Array, v: Array, now: float) -> Array:
        """The safe control."""
        return self._guard.step(q, v, now, self._opening).u
