"""Resolved-rate control of the policies: from tool poses to joint velocities, without a filter."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf

import numpy as np
from numpy.typing import NDArray

from dualbrain.core.geometry.rotations import rotation_error
from dualbrain.safety.cbf.filter import ToolState

Array = NDArray[np.float64]

DAMPING = 0.03
"""Damping of the inverse at singular poses [m]."""
POSTURE_GAIN = 1.0
"""Gain of the return of the redundant joint [1/s]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SpeedProfile:
    """Gains and bounds of the tool motion.

    `position_gain` and `rotation_gain` [1/s] reduce the pose error; `max_linear` [m/s] and `max_angular` [rad/s] bound
    the twist, `max_linear_acceleration` [m/s²] and `max_angular_acceleration` [rad/s²] its change. Joint velocities are
    scaled down to `max_joint_speed_share` of their limits.
    """

    position_gain: float
    rotation_gain: float
    max_linear: float = inf
    max_angular: float = inf
    max_linear_acceleration: float = inf
    max_angular_acceleration: float = inf
    max_joint_speed_share: float = inf


CAREFUL = SpeedProfile(
    position_gain=5.0,
    rotation_gain=4.0,
    max_linear=0.25,
    max_angular=1.0,
    max_linear_acceleration=1.0,
    max_angular_acceleration=4.0,
    max_joint_speed_share=0.6,
)
"""Within all limits of the arm."""
HASTY = SpeedProfile(position_gain=25.0, rotation_gain=25.0)
"""Five times the gains and no bounds: the first nominal tool speed for a path of 20 cm is 5 m/s."""


class ResolvedRateController:
    """u = J⁺(ν − J u₀) + u₀ with damping, ν = clip(k e) of bounded change, u₀ toward the initial posture."""

    def __init__(self, profile: SpeedProfile, max_speed: Array, posture: Array, period: float) -> None:
        """`max_speed` (n,) [rad/s] are the joints' limits; the redundant joint is drawn to `posture` (n,) [rad]."""
        self._profile, self._max_speed, self._posture, self._period = profile, max_speed, posture, period
        self._twist = np.zeros(6)

    def joint_velocity(self, tool: ToolState, q: Array, position: Array, rotation: Array) -> Array:
        """Joint velocities (n,) [rad/s] toward a pose of the tool."""
        profile, J = self._profile, tool.jacobian
        linear = _clip_norm(profile.position_gain * (position - tool.position), profile.max_linear)
        angular = _clip_norm(profile.rotation_gain * rotation_error(tool.rotation, rotation), profile.max_angular)
        self._twist[:3] += _clip_norm(linear - self._twist[:3], profile.max_linear_acceleration * self._period)
        self._twist[3:] += _clip_norm(angular - self._twist[3:], profile.max_angular_acceleration * self._period)
        drift = POSTURE_GAIN * (self._posture - q)
        ridge = DAMPING**2 * np.eye(6)
        u = drift + J.T @ np.linalg.solve(J @ J.T + ridge, self._twist - J @ drift)
        return u / max(1.0, float(np.max(np.abs(u) / self._max_speed)) / profile.max_joint_speed_share)


def _clip_norm(vector: Array, max_norm: float) -> Array:
    """The vector, shortened to the norm `max_norm`."""
    length = float(np.linalg.norm(vector))
    return vector * (max_norm / length) if length > max_norm else vector
