"""Inverse kinematics: joint angles that reach a tool pose, to compare goals and to reject unreachable ones."""

from __future__ import annotations

from collections.abc import Sequence
from math import sqrt

import numpy as np
from numpy.typing import NDArray

from dualbrain.core.geometry.rotations import rotation_error
from dualbrain.robots.model import RobotModel
from dualbrain.skills.skill import MotionModel
from dualbrain.skills.time_slicing import SlicedComputation

Array = NDArray[np.float64]

POSITION_TOLERANCE = 1e-3
"""Position tolerance of a solution [m]."""
ROTATION_TOLERANCE = 5e-3
"""Rotation tolerance of a solution [rad]."""
MAX_STEPS, MAX_STEPS_PER_CANDIDATE = 60, 20
"""Most steps of a solution: to decide whether a pose is reachable, and for one of many candidates.

Of the poses that are reached within 60 steps, 99 % are reached within 20 (Panda, FR3, UR5e; random poses).
"""
DAMPING = 1e-4
"""Damping of the inverse at singular poses [m²]."""


class InverseKinematics:
    """Damped least squares within the joint limits, from given start postures."""

    def __init__(self, robot_model: RobotModel, motion: MotionModel, *, inset: float = 0.08) -> None:
        """Use the limits of `robot_model`, reduced by `inset` [rad], and the kinematics of `motion`."""
        self._motion = motion
        self._lower = np.array([joint.lower.value for joint in robot_model.joints]) + inset
        self._upper = np.array([joint.upper.value for joint in robot_model.joints]) - inset
        self._home = np.array(robot_model.home)

    def solve(
        self, position: Array, rotation: Array, starts: Sequence[Array] = (), *, steps: int = MAX_STEPS
    ) -> SlicedComputation[Array | None]:
        """Joint angles (n,) [rad] that reach the pose, from the first start posture that converges, or None."""
        for start in (*starts, self._home_facing(position)):
            q = yield from self._solve_from(np.clip(start, self._lower, self._upper), position, rotation, steps)
            if q is not None:
                return q
        return None

    def solve_best(
        self, position: Array, rotations: Sequence[Array], start: Array
    ) -> SlicedComputation[tuple[Array, Array] | None]:
        """The rotation and joint angles of least posture cost (far from limits, close to `start`), or None."""
        choices: list[tuple[float, int, Array]] = []
        for index, rotation in enumerate(rotations):
            q = yield from self.solve(position, rotation, (start,))
            if q is not None:
                choices.append((self.posture_cost(q, start), index, q))
        if not choices:
            return None
        _, index, q = min(choices, key=lambda choice: choice[:2])
        return rotations[index], q

    def posture_cost(self, q: Array, start: Array) -> float:
        """Distance of `q` (n,) from `start` plus a penalty for closeness to a joint limit [rad]."""
        room = np.min(np.minimum(q - self._lower, self._upper - q))
        return float(np.linalg.norm(q - start) + 2.0 * np.exp(-4.0 * room))

    def _home_facing(self, position: Array) -> Array:
        start = self._home.copy()
        start[0] += np.arctan2(position[1], position[0])
        return start

    def _solve_from(self, q: Array, position: Array, rotation: Array, steps: int) -> SlicedComputation[Array | None]:
        error = np.empty(6)
        for _ in range(steps):
            yield
            tool = self._motion.tool(q)
            error[:3], error[3:] = position - tool.position, rotation_error(tool.rotation, rotation)
            if norm(error[:3]) < POSITION_TOLERANCE and norm(error[3:]) < ROTATION_TOLERANCE:
                return q
            step = self._motion.damped_least_squares(tool.jacobian, DAMPING, error, 0.05 * (self._home - q))
            q = q + step * min(1.0, 0.4 / (float(np.abs(step).max()) + 1e-12))
            q = np.minimum(np.maximum(q, self._lower), self._upper)
        return None


def norm(vector: Array) -> float:
    """Euclidean norm of a short vector; faster than `np.linalg.norm`."""
    return sqrt(float(vector @ vector))
