"""Did the base arrive? Judged on simulator truth, for evaluation only."""

from __future__ import annotations

import msgspec
import numpy as np

from dualbrain.simulation.plant.plant import Plant

NEAR = 0.20
"""Within this distance of a place it is reached [m]."""
STILL = 0.02
"""Slower than this the base stands [m/s, rad/s]."""


class At(msgspec.Struct, frozen=True):
    """Stand at `place`."""

    place: str


class Arrival:
    """Follows one goal `At` through an episode."""

    def __init__(self, plant: Plant, goal: At) -> None:
        """Remember how far the way is."""
        self._plant, self.goal = plant, goal
        self._far = self._nearest = self._away()

    def watch(self) -> None:
        """Note how near the base has come."""
        self._nearest = min(self._nearest, self._away())

    def judge(self) -> tuple[bool, float]:
        """(success, progress) as of now."""
        self.watch()
        success = self._away() < NEAR and bool(np.all(np.abs(self._plant.speed()) < STILL))
        return success, 1.0 if success else min(0.99, 1.0 - self._nearest / max(self._far, NEAR))

    def _away(self) -> float:
        spot = np.array(self._plant.spec.place(self.goal.place).position[:2])
        return float(np.linalg.norm(self._plant.ground() - spot))
