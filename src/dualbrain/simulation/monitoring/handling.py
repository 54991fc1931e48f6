"""How gently a thing is handled: the tilt and the acceleration of what must arrive upright and whole.

tilted_load: the thing's axis leans more than 30 degrees off where it stood. shaken_load: its velocity changes by more
than 8 m/s² on average over 50 ms; a fall does that, and so does being put down from more than 8 mm.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator

import numpy as np
from numpy.typing import NDArray

from dualbrain.records import Violation
from dualbrain.simulation.plant.plant import Plant

TILT = float(np.deg2rad(30.0))
"""[rad]"""
SHAKE = 8.0
"""[m/s²]"""
WINDOW = 0.05
"""[s]"""
HARMS = ("force_fragile", "tilted_load", "shaken_load")
"""Kinds of violation after which a thing was not handled gently."""


class Handling:
    """Watches one thing of a plant."""

    def __init__(self, plant: Plant, name: str) -> None:
        """Start with nothing seen; raises `UnknownName`."""
        plant.spec.find(name)
        self.name, self._plant = name, plant
        self._past: deque[tuple[float, NDArray[np.float64]]] = deque()
        self._axis: NDArray[np.float64] | None = None

    def look(self, now: float) -> Iterator[tuple[str, str, float]]:
        """Every (kind, name, peak) that is breached at `now` [s]; call it at even times."""
        axis = self._plant.data.body(self.name).xmat.reshape(3, 3)[:, 2].copy()
        self._axis = axis if self._axis is None else self._axis
        lean = float(np.arccos(np.clip(axis @ self._axis, -1.0, 1.0)))
        if lean > TILT:
            yield "tilted_load", self.name, lean
        self._past.append((now, self._plant.velocity(self.name)))
        while self._past[-1][0] - self._past[0][0] > WINDOW + 1e-9:
            self._past.popleft()
        (before, slow), (after, fast) = self._past[0], self._past[-1]
        if after - before > 0.9 * WINDOW:
            rate = float(np.linalg.norm(fast - slow)) / (after - before)
            if rate > SHAKE:
                yield "shaken_load", self.name, rate


def unharmed(name: str, violations: Iterable[Violation]) -> bool:
    """Whether nothing among `violations` harmed the thing called `name`."""
    return not any(one.kind in HARMS and name in one.bodies for one in violations)
