"""The judge of the experiment `speed_limits`: every step by the limits of its class, in float64."""

from __future__ import annotations

import numpy as np

from dualbrain.robots.model import RobotModel
from dualbrain.safety.cbf.obstacles import Obstacle
from experiments.engine.experiment import Row
from experiments.safety.speed_limits.classes import HELD, SpeedClass
from experiments.safety.speed_limits.least_share import control_bounds, least_share
from experiments.safety.speed_limits.point_speeds import Array, PointSpeeds
from experiments.safety.speed_limits.tables import USED
from experiments.safety.speed_limits.trial import PERSON, load_arm

CHUNK = 2000
"""Number of states that are judged at once."""
NEAR_ROUNDING, JERK_ROUNDING = 1e-4, 1e-3
"""Distance [m] that single precision leaves undecided at the edge of the person's distance, and share of the jerk."""


class Judge:
    """Speeds and jerks of a loop beside the limits of its class, from the robot model alone."""

    def __init__(self, kind: SpeedClass) -> None:
        """Judge loops of the class `kind`."""
        self._kind, self._robot_model = kind, load_arm(kind.robot)[0]
        self._points = PointSpeeds(self._robot_model, np.array(HELD) if kind.holds_object else np.zeros((0, 4)))
        self._radii = self._points.radii()

    def judge(self, q: Array, u: Array, person: Obstacle | None) -> tuple[list[int], Row]:
        """The steps with a part above its limit, and counts of steps.

        Steps above a limit or near it, the largest share of a limit, and steps with a part near the person.
        """
        shares, near = [], []
        for first in range(0, len(q), CHUNK):
            positions, speeds = self._points.measure(q[first : first + CHUNK], u[first : first + CHUNK])
            close = self._near(positions, person)
            shares.append((speeds / self._limits(close)).max(axis=1))
            near.append(close.any(axis=1))
        share = np.concatenate(shares)
        jerk = _jerk_shares(self._robot_model, u) if self._kind.judges_jerk else np.zeros(1)
        above = [int(step) for step in np.flatnonzero(share > 1.0)]
        return above, {
            "steps": len(q),
            "above": len(above),
            "used": int((share > USED).sum()),
            "near": int(np.concatenate(near).sum()),
            "jerks": int((jerk > 1.0 + JERK_ROUNDING).sum()),
            "largest": float(share.max()),
            "jerk": float(jerk.max()),
        }

    def least_share(self, q: Array, u: Array, person: Obstacle | None, step: int) -> float:
        """The least share of the limits that a control could attain in `step`, from the state before it."""
        rest = np.zeros((2, self._robot_model.n))
        earlier, before = np.vstack([rest, u[:step]])[-2:]
        positions, _ = self._points.measure(q[step : step + 1], u[step : step + 1])
        limits = self._limits(self._near(positions, person))[0]
        bounds = control_bounds(self._robot_model, before, before - earlier, limits_jerk=self._kind.judges_jerk)
        return least_share(self._points.jacobians(q[step]), limits, bounds)

    def _near(self, positions: Array, person: Obstacle | None) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
        """Whether the parts (t, k) at `positions` (t, k, 3) are near the person."""
        if person is None or self._kind.near is None:
            return np.zeros(positions.shape[:2], bool)
        return _distance(positions, person) - self._radii < self._kind.near.distance - NEAR_ROUNDING

    def _limits(self, near: np.ndarray[tuple[int, ...], np.dtype[np.bool_]]) -> Array:
        """Limits (t, k) [m/s] of the parts."""
        limit = np.inf if self._kind.limit is None else self._kind.limit
        slow = limit if self._kind.near is None else min(limit, self._kind.near.speed)
        return np.where(near, slow, limit)


def _distance(positions: Array, person: Obstacle) -> Array:
    """Distances (t, k) [m] of points (t, k, 3) from the surface of the upright person."""
    x, y, z = person.pose.position
    along = np.clip(positions[..., 2], z - PERSON.half_length, z + PERSON.half_length)
    return np.hypot(np.hypot(positions[..., 0] - x, positions[..., 1] - y), positions[..., 2] - along) - PERSON.radius


def _jerk_shares(robot_model: RobotModel, u: Array) -> Array:
    """Largest share (t,) of the jerk limit of a joint; the arm starts at rest."""
    limits = np.array([joint.jerk.value if joint.jerk else np.inf for joint in robot_model.joints])
    rest = np.zeros((2, robot_model.n))
    changes = np.diff(np.vstack([rest, u]), n=2, axis=0) / robot_model.period**2
    return np.abs(changes / limits).max(axis=1)
