"""Joint angles that reach a tool pose, for choosing between ways of grasping and for refusing what is out of reach."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import sqrt

import numpy as np
from numpy.typing import NDArray

from dualbrain.core.geometry.rotations import rotation_error
from dualbrain.robots.model import RobotModel
from dualbrain.skills.skill import ToolState
from dualbrain.skills.time_slicing import SlicedComputation

Array = NDArray[np.float64]

POSITION_TOLERANCE = 1e-3
"""A pose counts as reached within 1 mm …"""
ROTATION_TOLERANCE = 5e-3
"""… and 5 mrad."""
MAX_STEPS, MAX_STEPS_PER_CANDIDATE = 60, 20
"""Steps after which a solution is given up: where it decides what can be done, and where it is one choice of many.

Of the poses that are reached at all within 60 steps, 99 of 100 are within 20 (Panda, FR3, UR5e; drawn poses).
"""
DAMPING = 1e-4 * np.eye(6)
"""Keeps the inverse finite at singular poses [m²]."""


class InverseKinematics:
    """Damped least squares inside the joint limits, from given starting postures."""

    def __init__(self, robot_model: RobotModel, tool: Callable[[Array], ToolState], *, inset: float = 0.08) -> None:
        """Bind to the body's limits (kept away from by `inset` [rad]) and to its forward kinematics."""
        self._tool = tool
        self._lower = np.array([joint.lower.value for joint in robot_model.joints]) + inset
        self._upper = np.array([joint.upper.value for joint in robot_model.joints]) - inset
        self._home = np.array(robot_model.home)

    def solve(
        self, position: Array, rotation: Array, starts: Sequence[Array] = (), *, steps: int = MAX_STEPS
    ) -> SlicedComputation[Array | None]:
        """Joint angles (n,) [rad] that put the tool at the pose, from the first start that converges, or None."""
        for start in (*starts, self._home_facing(position)):
            q = yield from self._solve_from(np.clip(start, self._lower, self._upper), position, rotation, steps)
            if q is not None:
                return q
        return None

    def solve_best(
        self, position: Array, rotations: Sequence[Array], start: Array
    ) -> SlicedComputation[tuple[Array, Array] | None]:
        """The rotation and joint angles that lie most comfortably: far from limits, near `start`; or None."""
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
        """How far `q` (n,) lies from `start` and how close to a joint limit [rad]."""
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
            tool = self._tool(q)
            error[:3], error[3:] = position - tool.position, rotation_error(tool.rotation, rotation)
            if norm(error[:3]) < POSITION_TOLERANCE and norm(error[3:]) < ROTATION_TOLERANCE:
                return q
            step = damped_step(tool.jacobian, error, 0.05 * (self._home - q))
            q = q + step * min(1.0, 0.4 / (float(np.abs(step).max()) + 1e-12))
            q = np.minimum(np.maximum(q, self._lower), self._upper)
        return None


def damped_step(J: Array, wanted: Array, free: Array) -> Array:
    """J⁺(wanted − J free) + free, damped: what moves the tool by `wanted` (6,), the rest by `free` (n,) [rad]."""
    return J.T @ np.linalg.solve(J @ J.T + DAMPING, wanted - J @ free) + free


def norm(vector: Array) -> float:
    """Euclidean norm of a short vector, quickly."""
    return sqrt(float(vector @ vector))
