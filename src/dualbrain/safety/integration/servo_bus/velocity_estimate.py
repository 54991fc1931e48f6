"""Joint velocities from positions alone, for servos that report no velocity or a coarse one."""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

SAMPLES = 5
"""Number of readings in the fit. With readings every 5 ms the estimate is 10 ms late."""
MAX_GAP = 0.05
"""Time between two readings [s] after which the estimate begins again."""


class VelocityEstimate:
    """The slope of a straight line through the last readings, by least squares.

    The quantisation of an encoder by s becomes an error of about s/(√12 Δt) divided by the effect of the fit: with 5
    readings the error of one difference falls to a third.
    """

    def __init__(self, samples: int = SAMPLES) -> None:
        """Fit the last `samples` readings, at least 2."""
        self._readings: deque[tuple[float, Array]] = deque(maxlen=samples)

    def reset(self) -> None:
        """Forget all readings: the next estimate is zero."""
        self._readings.clear()

    def update(self, now: float, q: Array) -> Array:
        """The velocity (n,) [rad/s] after the reading `q` (n,) [rad] at `now` [s]; zero after the first reading.

        A reading that is not finite makes the estimate not finite and is forgotten. Readings from before a gap of more
        than `MAX_GAP`, or from after `now`, are forgotten.
        """
        if not np.isfinite(q).all():
            self.reset()
            return np.full_like(q, np.nan)
        if self._readings and not 0.0 < now - self._readings[-1][0] <= MAX_GAP:
            self.reset()
        self._readings.append((now, q.copy()))
        times = np.array([time for time, _ in self._readings], float) - now
        times -= times.mean()
        spread = float(times @ times)
        if spread <= 0.0:
            return np.zeros_like(q)
        return times @ np.array([reading for _, reading in self._readings]) / spread
