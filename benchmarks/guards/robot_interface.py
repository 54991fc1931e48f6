"""The arm's own interface below every guard: velocities within its limits of speed and acceleration, at 1 kHz."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dualbrain.robots.model import RobotModel

Array = NDArray[np.float64]


class RobotInterface:
    """Limits velocities as the controller of an arm does; `commanded` (n,) [rad] is their integral."""

    def __init__(self, robot_model: RobotModel, start: Array) -> None:
        self.period = robot_model.period
        self.v_max = np.array([joint.velocity.value for joint in robot_model.joints])
        self.a_max = np.array([joint.acceleration.value for joint in robot_model.joints])
        self.commanded, self.u = start.copy(), np.zeros(robot_model.n)

    def limit(self, u: Array) -> Array:
        """The nearest velocity (n,) [rad/s] within the limits of this period, which is then commanded."""
        step = self.a_max * self.period
        self.u = np.clip(np.clip(u, self.u - step, self.u + step), -self.v_max, self.v_max)
        self.commanded = self.commanded + self.period * self.u
        return self.u

    def velocity_towards(self, target: Array, duration: float) -> Array:
        """The constant velocity within the speed limits that reaches `target` (n,) [rad] in `duration` [s]."""
        return np.clip((target - self.commanded) / duration, -self.v_max, self.v_max)
