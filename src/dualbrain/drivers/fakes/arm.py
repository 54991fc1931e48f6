"""The joints of a fake arm: they follow a velocity with a lag, and brake by themselves when they are told nothing."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
LAG = 0.002
"""[s] v ← v + (w − v) dt / lag."""


class FakeArm:
    """Posture q (n,) [rad], velocity v (n,) [rad/s] and time [s]; `pace(now)` may delay each step for a real clock."""

    def __init__(self, home: tuple[float, ...], braking: float, pace: Callable[[float], None] | None = None) -> None:
        """At rest in `home`; with nothing to follow every joint brakes at `braking` [rad/s²]."""
        self.q: Array = np.array(home, dtype=float)
        self.v: Array = np.zeros(len(home))
        self.now = 0.0
        self._braking, self._pace = braking, pace

    def follow(self, target: Array | None, dt: float) -> None:
        """One step of `dt` [s] toward the velocity `wanted` (n,); with None it brakes."""
        before = self.v
        if target is None:
            self.v = np.sign(before) * np.maximum(0.0, np.abs(before) - self._braking * dt)
        else:
            self.v = before + (target - before) * min(1.0, dt / LAG)
        self.q = self.q + 0.5 * (before + self.v) * dt
        self.now += dt
        if self._pace:
            self._pace(self.now)
