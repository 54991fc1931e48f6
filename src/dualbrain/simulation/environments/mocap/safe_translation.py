"""The displacement of a tool nearest to a wanted one that the barriers admit without a turn of the tool.

The filter poses rows a'u ≥ b for the joint velocity u of one period dt. A displacement x (3,) in an action of N periods
is the mean velocity u = J⁺ (x, 0) / (N dt). Over these periods h falls at most by the share 1 − (1 − α dt)ᴺ, so a row
with b < 0 becomes a'u ≥ b (1 − (1 − α dt)ᴺ) / (α N dt), and one with b ≥ 0, which leads away, stays as it is. Every h
counts as smaller by `BAND`: a tool that slides along an obstacle then keeps clear of the place where the filter would
brake it for each curvature of its path.

The rows are those of the last step of the filter. The result is therefore a proposal: the filter checks it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.safety.cbf.qp import ControlQp

Array = NDArray[np.float64]

MAX_SHIFT = 0.1
"""Largest displacement in one action [m]."""
BAND = 2e-3
"""Distance [m] by which a displacement stays farther from obstacles than the filter demands."""
DAMPING = 0.02
"""Damping of the inverse of the Jacobian [m, rad]."""


class SafeTranslation:
    """Displacements that the rows of the last step admit; without rows, and if none is admitted, there is no answer."""

    def __init__(self, safety: SafetyFilter, steps: int) -> None:
        """The rows are those of `safety`; one action lasts `steps` periods of its robot model."""
        self._safety, dt = safety, safety.robot_model.period
        self._time = steps * dt
        self._alpha = safety.robot_model.alpha
        self._share = (1.0 - max(0.0, 1.0 - self._alpha * dt) ** steps) / (self._alpha * self._time)
        self._qp = ControlQp(np.ones(3))
        self.reset()

    def reset(self) -> None:
        """Forget the rows."""
        self._A, self._b = np.empty((0, self._safety.robot_model.n)), np.empty(0)

    def read_rows(self) -> None:
        """Take the rows of the last step of the filter."""
        rows = self._safety.rows()
        if not rows:
            self.reset()
            return
        self._A = np.array([row.a for row in rows])
        self._b = np.array([row.b + self._alpha * BAND / row.norm for row in rows])

    def nearest(self, shift: Array, jacobian: Array) -> Array | None:
        """The admitted displacement (3,) [m] nearest to `shift` (3,); None if `shift` itself is, or if none is.

        `jacobian` (6, n) is that of the tool.
        """
        if len(self._b) == 0 or not np.isfinite(shift).all():
            return None
        inverse = jacobian.T @ np.linalg.inv(jacobian @ jacobian.T + DAMPING**2 * np.eye(6))
        A = self._A @ inverse[:, :3] / self._time
        b = np.where(self._b < 0.0, self._b * self._share, self._b)
        if np.all(A @ shift >= b):
            return None
        found = self._qp.solve(A, b, np.full(3, -MAX_SHIFT), np.full(3, MAX_SHIFT), shift)
        return found.u if found.rows_met else None
