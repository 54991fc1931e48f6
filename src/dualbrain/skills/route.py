"""The bend of a journey: where a route other than the straight one passes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

NEAR_BASE = 0.36
"""Distance from the base at which the route close to the base passes [m]."""
ASIDE = 0.15
"""How far left and right routes bend from the straight line [m]."""
REACH = (0.34, 0.68)
"""A bend stays within this distance from the base [m]."""


def bend(start: Array, end: Array, route: str) -> Array | None:
    """The point (3,) that `route` passes between `start` and `end`, at the height of `end`; None when straight."""
    if route == "direct":
        return None
    middle = (start + end)[:2] / 2
    if route == "near_base":
        via = middle * (NEAR_BASE / (np.linalg.norm(middle) + 1e-9))
    else:
        line = (end - start)[:2]
        left = np.array([-line[1], line[0]]) / (np.linalg.norm(line) + 1e-9)
        via = middle + (ASIDE if route == "left" else -ASIDE) * left
        distance = float(np.linalg.norm(via))
        via = via * (float(np.clip(distance, *REACH)) / (distance + 1e-9))
    return np.array([via[0], via[1], end[2]])
