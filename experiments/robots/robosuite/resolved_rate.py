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
POSTURE = 1.0
"""How fast the redundant joint returns [1/s]."""


@dataclass(frozen=True, slots=True)
class Pace:
    """How hard the tool is driven.

    `position` and `rotation` [1/s] close the pose error; `linear` [m/s], `angular` [rad/s] bound the twist, and
    `linear_change` [m/s²], `angular_change` [rad/s²] how fast it changes; joint velocities are scaled down to `share`
    of their limits.
    """

    position: float
    rotation: float
    linear: float = inf
    angular: float = inf
    linear_change: float = inf
    angular_change: float = inf
    share: float = inf


CAREFUL = Pace(5.0, 4.0, linear=0.25, angular=1.0, linear_change=1.0, angular_change=4.0, share=0.6)
"""Within every limit of the arm."""
HASTY = Pace(25.0, 25.0)
"""As fast as it goes, five times the gains and no bounds: the first wish of a way of 20 cm is 5 m/s."""


class Reach:
    """u = J⁺(ν − J u₀) + u₀ with damping, ν = clip(k e) of limited change, u₀ a pull to the posture of the start."""

    def __init__(self, pace: Pace, fastest: Array, posture: Array, period: float) -> None:
        """`fastest` (n,) [rad/s] are the joints' limits, `posture` (n,) [rad] where the redundant joint is drawn."""
        self._pace, self._fastest, self._posture, self._period = pace, fastest, posture, period
        self._twist = np.zeros(6)

    def toward(self, tool: ToolState, q: Array, position: Array, rotation: Array) -> Array:
        """Joint velocities (n,) [rad/s] toward a pose of the tool."""
        pace, J = self._pace, tool.jacobian
        linear = _within(pace.position * (position - tool.position), pace.linear)
        angular = _within(pace.rotation * rotation_error(tool.rotation, rotation), pace.angular)
        self._twist[:3] += _within(linear - self._twist[:3], pace.linear_change * self._period)
        self._twist[3:] += _within(angular - self._twist[3:], pace.angular_change * self._period)
        drift = POSTURE * (self._posture - q)
        ridge = DAMPING**2 * np.eye(6)
        u = drift + J.T @ np.linalg.solve(J @ J.T + ridge, self._twist - J @ drift)
        return u / max(1.0, float(np.max(np.abs(u) / self._fastest)) / pace.share)


def _within(vector: Array, longest: float) -> Array:
    """The vector, shortened to `longest`."""
    length = float(np.linalg.norm(vector))
    return vector * (longest / length) if length > longest else vector
