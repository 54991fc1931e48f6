"""What the makers allow, apart from what our bodies say: a fake refuses by it, and commissioning stays inside it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

FR3_VELOCITY_CAP = np.array((2.62, 2.62, 2.62, 2.62, 5.26, 4.18, 5.26))
_UPPER_COEFFICIENTS = np.array(
    (
        (0.30, 12.0, 2.75010),
        (0.20, 5.17, 1.79180),
        (0.20, 7.00, 2.90650),
        (0.30, 8.00, -0.1458),
        (0.35, 34.0, 2.81010),
        (0.35, 11.0, 4.52050),
        (0.35, 34.0, 3.01960),
    )
)
_LOWER_POSITION = np.array((-2.75010, -1.79180, -2.90650, -3.04810, -2.81010, 0.54092, -3.01960))
_OFFSET, _SLOPE, _UPPER_POSITION = _UPPER_COEFFICIENTS.T


@dataclass(frozen=True, slots=True, kw_only=True)
class VendorLimits:
    """A maker's limits: range (n, 2) [rad], acceleration and jerk (n,) [rad/s², rad/s³], None where none is published.

    `velocities(q)` gives the least and the greatest velocity (n,) [rad/s] at posture q.
    """

    position_range: Array
    velocity_limits: Callable[[Array], tuple[Array, Array]]
    acceleration: Array | None
    jerk: Array | None
    source: str


def fr3_velocity_limits(q: Array) -> tuple[Array, Array]:
    """Velocity limits of a Franka Research 3 at q: v̄ᵢ = min(boxᵢ, max(0, −oᵢ + √(sᵢ (q̄ᵢ − qᵢ)))), and its mirror."""
    up = np.minimum(
        FR3_VELOCITY_CAP, np.maximum(0.0, -_OFFSET + np.sqrt(np.maximum(0.0, _SLOPE * (_UPPER_POSITION - q))))
    )
    down = np.minimum(
        FR3_VELOCITY_CAP, np.maximum(0.0, -_OFFSET + np.sqrt(np.maximum(0.0, _SLOPE * (q - _LOWER_POSITION))))
    )
    return -down, up


def ur5e_velocity_limits(q: Array) -> tuple[Array, Array]:
    """Every joint of a UR5e turns at 180 degrees a second at most."""
    top = np.full(len(q), np.pi)
    return -top, top


FR3 = VendorLimits(
    position_range=np.array(
        (
            (-2.7437, 2.7437),
            (-1.7837, 1.7837),
            (-2.9007, 2.9007),
            (-3.0421, -0.1518),
            (-2.8065, 2.8065),
            (0.5445, 4.5169),
            (-3.0159, 3.0159),
        )
    ),
    velocity_limits=fr3_velocity_limits,
    acceleration=np.full(7, 10.0),
    jerk=np.full(7, 5000.0),
    source="Franka Control Interface: limits of the Franka Research 3, velocity limits by position",
)
UR5E = VendorLimits(
    position_range=np.full((6, 2), 2.0 * np.pi) * (-1.0, 1.0),
    velocity_limits=ur5e_velocity_limits,
    acceleration=None,
    jerk=None,
    source="UR5e technical data sheet: ±360°, 180°/s; no acceleration limit is published",
)
