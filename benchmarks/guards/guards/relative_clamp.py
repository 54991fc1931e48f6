"""LeRobot's own limit, `max_relative_target`: a target at most 5 degrees from the measured position of each joint."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from benchmarks.guards.guards.guard import TargetGuard

Array = NDArray[np.float64]
MAX_RELATIVE_TARGET = np.radians(5.0)
"""The value of LeRobot's documentation for its follower arms [rad]."""


class RelativeClamp(TargetGuard):
    """Clamps the target around the measured posture."""

    def safe_target(self, action: Array, q: Array) -> Array:
        """`action` within the limit around q."""
        return q + np.clip(action - q, -MAX_RELATIVE_TARGET, MAX_RELATIVE_TARGET)
