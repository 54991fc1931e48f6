"""The wheels' own controller: how a base comes to drive at the speed that it is told."""

from __future__ import annotations

from math import exp

import numpy as np

from dualbrain.robots.interface import Array
from dualbrain.robots.mobile_manipulator import BASE_JOINTS as DRIVEN
from dualbrain.robots.model import Body
from dualbrain.simulation.scenes.scene_builder import PERIOD

LAG = 0.04
"""[s]"""


class Wheels:
    """Follows (v, ω) with a first-order lag, never faster than the body's limits, which are set in it.

    w ← u + e^(−dt/LAG) (w − u) with u clipped to ± the limits, as the motor controllers of bases do by themselves: so a
    wire that carries noise cannot make the base too fast.
    """

    def __init__(self, body: Body) -> None:
        """At rest."""
        self._limit = np.array([joint.velocity.value for joint in body.joints[:DRIVEN]])
        self._keep = exp(-PERIOD / LAG)
        self.speed: Array = np.zeros(DRIVEN)
        """(v, ω) [m/s, rad/s]"""

    def follow(self, told: Array) -> Array:
        """(v, ω) after one period of being `told` a speed."""
        u = np.clip(told, -self._limit, self._limit)
        self.speed = u + self._keep * (self.speed - u)
        return self.speed

    def forget(self) -> None:
        """Stand still."""
        self.speed = np.zeros(DRIVEN)
