"""Joints of a fake arm: they follow a target velocity with a lag, and brake without a target."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
LAG = 0.002
"""Time constant of the joints [s]: v ← v + (target − v) dt / LAG."""


class FakeArm:
    """Posture q (n,) [rad], velocity v (n,) [rad/s] and time `now` [s] of a fake arm."""

    def __init__(self, home: tuple[float, ...], braking: float, pace: Callable[[float], None] | None = None) -> None:
        """At rest in `home` [rad]; `braking` [rad/s²] applies without a target, `pace(now)` may delay each step."""
        self.q: Array = np.array(home, dtype=float)
        self.v: Array = np.zeros(len(home))
        self.now = 0.0
        self._braking, self._pace = braking, pace

    def follow(self, target: Array | None, dt: float) -> None:
        """One step of `dt` [s] towards the velocity `target` (n,) [rad/s]; None brakes all joints."""
        before = self.v
        if target is None:
            self.v = np.sign(before) * np.maximum(0.0, np.abs(before) - self._braking * dt)
        else:
            self.v = before + (target - before) * min(1.0, dt / LAG)
        self.q = self.q + 0.5 * (before + self.v) * dt
        self.now += dt
        if self._pace:
            self._pace(self.now)
