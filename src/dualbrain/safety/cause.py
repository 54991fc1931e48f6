"""The name of what changed a control: the pair that is near, or a joint and which of its limits."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dualbrain.embodiment.body import Body
from dualbrain.safety.result import LOWER, UPPER, Filtered, Status

Array = NDArray[np.float64]

AT_BOUND = 1e-4
"""A control this close [rad/s] to a bound lies on it."""


class Causes:
    """Names the cause of an answer.

    The kernel's box is one interval for each joint; which of its three limits it is at follows from the control that
    was in force before.
    """

    def __init__(self, body: Body) -> None:
        """Read the limits of `body`."""
        self._v_max = np.array([joint.velocity.value for joint in body.joints])
        self._step = np.array([joint.acceleration.value for joint in body.joints]) * body.period

    def name(self, answer: Filtered, u_prev: Array) -> str:
        """The strongest cause of a changed control after `u_prev` (n,) [rad/s]; "" when nothing was changed."""
        if answer.status > Status.MODIFIED and not answer.rows:
            return ", ".join(flag.name.lower().replace("_", " ") for flag in answer.reason if flag.name)
        joints = [row for row in answer.rows if row[0] in (LOWER, UPPER)]
        others = [row for row in answer.rows if row[0] not in (LOWER, UPPER)]
        if others and (not joints or answer.delta_rows >= answer.delta_box):
            kind, i, j, _, _ = max(others, key=lambda row: row[4])
            return answer.names.row(kind, i, j)
        if joints:
            names = [(self._limit(answer, u_prev, row[0], row[1]), row) for row in joints]
            return max(names, key=lambda entry: ("position" in entry[0], entry[1][4]))[0]
        return "" if answer.status is Status.SAFE else "rounding"

    def _limit(self, answer: Filtered, u_prev: Array, kind: int, joint: int) -> str:
        """Which limit of `joint` holds its control, from below or from above."""
        sign = -1.0 if kind == LOWER else 1.0
        u = sign * float(answer.u[joint])
        name = answer.names.joints[joint]
        if u > self._v_max[joint] - AT_BOUND:
            return f"{name} velocity limit"
        if u > sign * u_prev[joint] + self._step[joint] - AT_BOUND:
            return f"{name} acceleration limit"
        return f"{name} position limit"
