"""Joint angles that reach a tool pose, for choosing between ways of grasping and for refusing what is out of reach."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from dualbrain.embodiment.body import Body
from dualbrain.linalg import rotation_error
from dualbrain.skills.skill import ToolState

Array = NDArray[np.float64]

POSITION_TOLERANCE = 1e-3
"""A pose counts as reached within 1 mm …"""
ROTATION_TOLERANCE = 5e-3
"""… and 5 mrad."""


class InverseKinematics:
    """Damped least squares inside the joint limits, from given starting postures."""

    def __init__(self, body: Body, tool: Callable[[Array], ToolState], *, inset: float = 0.08) -> None:
        """Bind to the body's limits (kept away from by `inset` [rad]) and to its forward kinematics."""
        self._tool = tool
        self._lower = np.array([joint.lower.value for joint in body.joints]) + inset
        self._upper = np.array([joint.upper.value for joint in body.joints]) - inset
        self._home = np.array(body.home)

    def solve(self, position: Array, rotation: Array, starts: Sequence[Array] = (), *, steps: int = 60) -> Array | None:
        """Joint angles (n,) [rad] that put the tool at the pose, from the first start that converges, or None."""
        for start in (*starts, self._facing(position)):
            q = self._descend(np.clip(start, self._lower, self._upper), position, rotation, steps)
            if q is not None:
                return q
        return None

    def best(self, position: Array, rotations: Sequence[Array], start: Array) -> tuple[Array, Array] | None:
        """The rotation and joint angles that lie most comfortably: far from limits, near `start`; or None."""
        choices: list[tuple[float, int, Array]] = []
        for index, rotation in enumerate(rotations):
            q = self.solve(position, rotation, (start,))
            if q is not None:
                choices.append((self.discomfort(q, start), index, q))
        if not choices:
            return None
        _, index, q = min(choices, key=lambda choice: choice[:2])
        return rotations[index], q

    def discomfort(self, q: Array, start: Array) -> float:
        """How far `q` (n,) lies from `start` and how close to a joint limit [rad]."""
        room = np.min(np.minimum(q - self._lower, self._upper - q))
        return float(np.linalg.norm(q - start) + 2.0 * np.exp(-4.0 * room))

    def _facing(self, position: Array) -> Array:
        start = self._home.copy()
        start[0] += np.arctan2(position[1], position[0])
        return start

    def _descend(self, q: Array, position: Array, rotation: Array, steps: int) -> Array | None:
        for _ in range(steps):
            tool = self._tool(q)
            error = np.concatenate([position - tool.position, rotation_error(tool.rotation, rotation)])
            if np.linalg.norm(error[:3]) < POSITION_TOLERANCE and np.linalg.norm(error[3:]) < ROTATION_TOLERANCE:
                return q
            J = tool.jacobian
            free = 0.05 * (self._home - q)
            step = J.T @ np.linalg.solve(J @ J.T + 1e-4 * np.eye(6), error - J @ free) + free
            q = np.clip(q + step * min(1.0, 0.4 / (np.max(np.abs(step)) + 1e-12)), self._lower, self._upper)
        return None
