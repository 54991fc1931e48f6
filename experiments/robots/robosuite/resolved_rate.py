"""From tool poses to joint velocities: a resolved-rate law of whoever wrote the policy, with no filter in it."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf

import numpy as np
from numpy.typing import NDArray

from dualbrain.core.geometry.rotations import rotation_error
from dualbrain.safety.cbf.filter import ToolState

Array = NDArray[np.float64]

DAMPING = 0.03
"""Keeps the inverse finite at singular poses [m]."""
POSTURE_GAIN = 1.0
"""How fast the redundant joint returns [1/s]."""


@dataclass(frozen=True, slots=True)
class SpeedProfile:
    """How hard the tool is driven.

    `position` and `rotation` [1/s] close the pose error; `linear` [m/s], `angular` [rad/s] bound the twist, and
    `linear_change` [m/s²], `angular_change` [rad/s²] how fast it changes; joint velocities are scaled down to `share`
    of their limits.
    """

    position_gain: float
    rotation_gain: float
    max_linear: float = inf
    max_angular: float = inf
    max_linear_acceleration: float = inf
    max_angular_acceleration: float = inf
    max_joint_speed_share: float = inf


CAREFUL = SpeedProfile(
    5.0,
    4.0,
    max_linear=0.25,
    max_angular=1.0,
    max_linear_acceleration=1.0,
    max_angular_acceleration=4.0,
    max_joint_speed_share=0.6,
)
"""Within every limit of the arm."""
HASTY = SpeedProfile(25.0, 25.0)
"""As fast as it goes, five times the gains and no bounds: the first wish of a way of 20 cm is 5 m/s."""


class ResolvedRateController:
    """u = J⁺(ν − J u₀) + u₀ with damping, ν = clip(k e) of limited change, u₀ a pull to the posture of the start."""

    def __init__(self, pace: SpeedProfile, fastest: Array, posture: Array, period: float) -> None:
        """`fastest` (n,) [rad/s] are the joints' limits, `posture` (n,) [rad] where the redundant joint is drawn."""
        self._profile, self._max_speed, self._posture, self._period = pace, fastest, posture, period
        self._twist = np.zeros(6)

    def joint_velocity(self, tool: ToolState, q: Array, position: Array, rotation: Array) -> Array:
        """Joint velocities (n,) [rad/s] toward a pose of the tool."""
        pace, J = self._profile, tool.jacobian
        linear = _clip_norm(pace.position_gain * (position - tool.position), pace.max_linear)
        angular = _clip_norm(pace.rotation_gain * rotation_error(tool.rotation, rotation), pace.max_angular)
        self._twist[:3] += _clip_norm(linear - self._twist[:3], pace.max_linear_acceleration * self._period)
        self._twist[3:] += _clip_norm(angular - self._twist[3:], pace.max_angular_acceleration * self._period)
        drift = POSTURE_GAIN * (self._posture - q)
        ridge = DAMPING**2 * np.eye(6)
        u = drift + J.T @ np.linalg.solve(J @ J.T + ridge, self._twist - J @ drift)
        return u / max(1.0, float(np.max(np.abs(u) / self._max_speed)) / pace.max_joint_speed_share)


def _clip_norm(vector: Array, longest: float) -> Array:
    """The vector, shortened to `longest`."""
    length = float(np.linalg.norm(vector))
    return vector * (longest / length) if length > longest else vector
