"""The wheels' own controller: how a base comes to drive at the speed that it is told."""

from __future__ import annotations

from math import exp

import numpy as np

from dualbrain.robots.interface import Array
from dualbrain.robots.mobile_manipulator import BASE_JOINTS as DRIVEN
from dualbrain.robots.model import RobotModel
from dualbrain.simulation.scenes.scene_builder import PHYSICS_PERIOD

WHEEL_LAG = 0.04
"""[s]"""


class WheelDrive:
    """Follows (v, ω) with a first-order lag, never faster than the body's limits, which are set in it.

    w ← u + e^(−dt/LAG) (w − u) with u clipped to ± the limits, as the motor controllers of bases do by themselves: so a
    wire that carries noise cannot make the base too fast.
    """

    def __init__(self, robot_model: RobotModel) -> None:
        """At rest."""
        self._velocity_limit = np.array([joint.velocity.value for joint in robot_model.joints[:DRIVEN]])
        self._decay = exp(-PHYSICS_PERIOD / WHEEL_LAG)
        self.velocity: Array = np.zeros(DRIVEN)
        """(v, ω) [m/s, rad/s]"""

    def update(self, command: Array) -> Array:
        """(v, ω) after one period of being `told` a speed."""
        u = np.clip(command, -self._velocity_limit, self._velocity_limit)
        self.velocity = u + self._decay * (self.velocity - u)
        return self.velocity

    def reset(self) -> None:
        """Stand still."""
        self.velocity = np.zeros(DRIVEN)
