"""Success of a task to drive to a place, judged on simulator ground truth; for evaluation only."""

from __future__ import annotations

import msgspec
import numpy as np

from dualbrain.simulation.plant.plant import Plant

ARRIVAL_DISTANCE = 0.20
"""A place is reached within this distance [m]."""
MAX_STANDSTILL_SPEED = 0.02
"""A base below this speed is at rest [m/s, rad/s]."""


class ArrivalGoal(msgspec.Struct, frozen=True):
    """The robot rests at `place`."""

    place: str


class ArrivalJudge:
    """Judges one `ArrivalGoal` during an episode: call `update` from time to time, then `score`."""

    def __init__(self, plant: Plant, goal: ArrivalGoal) -> None:
        """Record the initial distance; raises `UnknownNameError` for a place that is not in the scene."""
        self._plant, self.goal = plant, goal
        self._start_distance = self._min_distance = self._distance()

    def update(self) -> None:
        """Record the smallest distance to the place so far."""
        self._min_distance = min(self._min_distance, self._distance())

    def score(self) -> tuple[bool, float]:
        """Success, and progress in [0, 1] as the share of the initial distance that was covered."""
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
