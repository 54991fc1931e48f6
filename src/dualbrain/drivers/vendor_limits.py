"""Limits of the manufacturers, independent of the robot models: used by the fakes and by commissioning."""

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
    """Limits of a manufacturer: range (n, 2) [rad], acceleration (n,) [rad/s²], jerk (n,) [rad/s³].

    Acceleration and jerk are None if they are not published. `velocity_limits(q)` returns the minimum and maximum
    velocity (n,) [rad/s] at posture q.
    """

    position_range: Array
    velocity_limits: Callable[[Array], tuple[Array, Array]]
    acceleration: Array | None
    jerk: Array | None
    source: str


def fr3_velocity_limits(q: Array) -> tuple[Array, Array]:
    """Minimum and maximum velocity (7,) [rad/s] of a Franka Research 3 at posture q (7,) [rad].

    v̄ᵢ = min(capᵢ, max(0, −oᵢ + √(sᵢ (q̄ᵢ − qᵢ)))), and the same for the lower end of the range.
    """
    upper = np.minimum(
        FR3_VELOCITY_CAP, np.maximum(0.0, -_OFFSET + np.sqrt(np.maximum(0.0, _SLOPE * (_UPPER_POSITION - q))))
    )
    lower = np.minimum(
        FR3_VELOCITY_CAP, np.maximum(0.0, -_OFFSET + np.sqrt(np.maximum(0.0, _SLOPE * (q - _LOWER_POSITION))))
    )
    return -lower, upper


def ur5e_velocity_limits(q: Array) -> tuple[Array, Array]:
    """Minimum and maximum velocity (6,) [rad/s] of a UR5e: ±180° per second for every joint."""
    maximum = np.full(len(q), np.pi)
    return -maximum, maximum


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
