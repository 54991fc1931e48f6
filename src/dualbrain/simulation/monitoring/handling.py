"""Gentle handling: limits on the tilt and the acceleration of an object that must arrive upright and undamaged.

`tilted_load`: the object's axis leans more than 30 degrees from its initial direction. `shaken_load`: the average
acceleration over 50 ms exceeds 8 m/s²; a fall causes it, and so does release more than 8 mm above the support.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator

import numpy as np
from numpy.typing import NDArray

from dualbrain.records import Violation
from dualbrain.simulation.plant.plant import Plant

MAX_TILT = float(np.deg2rad(30.0))
"""[rad]"""
MAX_ACCELERATION = 8.0
"""[m/s²]"""
ACCELERATION_WINDOW = 0.05
"""[s]"""
HARM_KINDS = ("force_fragile", "tilted_load", "shaken_load")
"""Kinds of violation that count as rough handling of an object."""


class HandlingMonitor:
    """Monitors tilt and acceleration of one object of a plant."""

    def __init__(self, plant: Plant, name: str) -> None:
        """Monitor the object called `name`; raises `UnknownNameError`."""
        plant.spec.find(name)
        self.name, self._plant = name, plant
        self._velocities: deque[tuple[float, NDArray[np.float64]]] = deque()
        self._start_axis: NDArray[np.float64] | None = None

    def find_violations(self, now: float) -> Iterator[tuple[str, str, float]]:
        """Every violation (kind, name, peak) at `now` [s]; call it at regular intervals."""
        axis = self._plant.data.body(self.name).xmat.reshape(3, 3)[:, 2].copy()
        self._start_axis = axis if self._start_axis is None else self._start_axis
        lean = float(np.arccos(np.clip(axis @ self._start_axis, -1.0, 1.0)))
        if lean > MAX_TILT:
            yield "tilted_load", self.name, lean
        self._velocities.append((now, self._plant.object_velocity(self.name)))
        while self._velocities[-1][0] - self._velocities[0][0] > ACCELERATION_WINDOW + 1e-9:
            self._velocities.popleft()
        (before, slow), (after, fast) = self._velocities[0], self._velocities[-1]
        if after - before > 0.9 * ACCELERATION_WINDOW:
            rate = float(np.linalg.norm(fast - slow)) / (after - before)
            if rate > MAX_ACCELERATION:
                yield "shaken_load", self.name, rate


def is_unharmed(name: str, violations: Iterable[Violation]) -> bool:
    """Whether none of `violations` is rough handling of the object called `name`."""
    return not any(one.kind in HARM_KINDS and name in one.bodies for one in violations)
