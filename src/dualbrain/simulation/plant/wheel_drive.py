"""Wheel controller of a mobile base: first-order response to velocity commands."""

from __future__ import annotations

from math import exp

import numpy as np

from dualbrain.robots.interface import Array
from dualbrain.robots.mobile_manipulator import BASE_JOINTS
from dualbrain.robots.model import RobotModel
from dualbrain.simulation.scenes.scene_builder import PHYSICS_PERIOD

WHEEL_LAG = 0.04
"""Time constant of the wheels [s]."""


class WheelDrive:
    """Follows (v, ω) with a first-order lag, within the velocity limits of the robot model.

    w ← u + e^(−dt/WHEEL_LAG) (w − u) with u clipped to ± the limits. Like the motor controllers of real bases, it
    limits the speed by itself, so that a corrupted command cannot exceed the limits.
    """

    def __init__(self, robot_model: RobotModel) -> None:
        """Start at rest with the velocity limits of `robot_model`."""
        self._velocity_limit = np.array([joint.velocity.value for joint in robot_model.joints[:BASE_JOINTS]])
        self._decay = exp(-PHYSICS_PERIOD / WHEEL_LAG)
        self.velocity: Array = np.zeros(BASE_JOINTS)
        """Present (v, ω) [m/s, rad/s]."""

    def update(self, command: Array) -> Array:
        """(v, ω) [m/s, rad/s] after one physics step with the command (v, ω)."""
        u = np.clip(command, -self._velocity_limit, self._velocity_limit)
        self.velocity = u + self._decay * (self.velocity - u)
        return self.velocity

    def reset(self) -> None:
        """Stop immediately."""
        self.velocity = np.zeros(BASE_JOINTS)
