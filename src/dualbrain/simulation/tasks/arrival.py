"""Did the base arrive? Judged on simulator truth, for evaluation only."""

from __future__ import annotations

import msgspec
import numpy as np

from dualbrain.simulation.plant.plant import Plant

ARRIVAL_DISTANCE = 0.20
"""Within this distance of a place it is reached [m]."""
MAX_STANDSTILL_SPEED = 0.02
"""Slower than this the base stands [m/s, rad/s]."""


class ArrivalGoal(msgspec.Struct, frozen=True):
    """Stand at `place`."""

    place: str


class ArrivalJudge:
    """Follows one goal `At` through an episode."""

    def __init__(self, plant: Plant, goal: ArrivalGoal) -> None:
        """Remember how far the way is."""
        self._plant, self.goal = plant, goal
        self._start_distance = self._min_distance = self._distance()

    def update(self) -> None:
        """Note how near the base has come."""
        self._min_distance = min(self._min_distance, self._distance())

    def score(self) -> tuple[bool, float]:
        """(success, progress) as of now."""
        self.update()
        success = self._distance() < ARRIVAL_DISTANCE and bool(
            np.all(np.abs(self._plant.robot_velocity()) < MAX_STANDSTILL_SPEED)
        )
        return success, 1.0 if success else min(
            0.99, 1.0 - self._min_distance / max(self._start_distance, ARRIVAL_DISTANCE)
        )

    def _distance(self) -> float:
        spot = np.array(self._plant.spec.find_place(self.goal.place).position[:2])
        return float(np.linalg.norm(self._plant.ground_position() - spot))
