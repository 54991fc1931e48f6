"""Closest control that satisfies every row: the QP of the C kernel in float64, for any number of rows."""

from __future__ import annotations

import msgspec
import numpy as np
from numpy.typing import NDArray

from dualbrain.errors import ConfigurationError
from dualbrain.safety.cbf.compiled import _kernel64

Array = NDArray[np.float64]

MAX_CONTROLS = 8
"""Most controls of the kernel's QP."""
MAX_ROWS = 512
"""Most rows of the kernel's QP. Problems may have more rows, as long as the solution needs fewer."""
ROWS_PER_CALL = 48
"""Number of rows that are added to the kernel's problem per iteration."""
ROW_TOLERANCE = 1e-8
"""Violation of a row that the check after the QP accepts, relative to the norm of the row."""


class QpResult(msgspec.Struct, frozen=True, eq=False, kw_only=True):
    """Result of one QP: `u` (n,), whether all rows are met, and the active constraints.

    `active` holds (index, multiplier) with index 0..n−1 for lower bounds, n..2n−1 for upper bounds, then rows. If rows
    conflict, it is a Farkas certificate. If `limit_reached`, the solver stopped at a limit and u is not a solution.
    """

    u: Array
    rows_met: bool
    limit_reached: bool
    iterations: int
    active: tuple[tuple[int, float], ...]


class ControlQp:
    """min ½‖u − u_nom‖²_R  s.t.  A u ≥ b, lower ≤ u ≤ upper, in controls scaled by `unit` (paper 4.3).

    Guarantee: a result with `rows_met` has passed a check of the box and the rows that is independent of the solver.
    """

    def __init__(self, unit: Array, weight: Array | None = None) -> None:
        """`unit` (n,) is the size of each control; `weight` is R (n, n), by default diag(1/unit²).

        Raises:
            ConfigurationError: more than 8 controls, or R is not symmetric positive definite.
        """
        self.unit, n = unit, len(unit)
        if not 1 <= n <= MAX_CONTROLS:
            raise ConfigurationError("controls", got=n, allowed=f"1 to {MAX_CONTROLS}, which the kernel's QP holds")
        R = np.eye(n) if weight is None else unit[:, None] * np.asarray(weight, float) * unit
        try:
            self._scale = np.array(np.linalg.inv(np.linalg.cholesky(R)).T, np.float64, order="C")
        except np.linalg.LinAlgError:
            raise ConfigurationError("weight R", got=weight, allowed="symmetric positive definite") from None

    def solve(self, A: Array, b: Array, lower: Array, upper: Array, u_nom: Array) -> QpResult:
        """The closest control to u_nom (n,), which is returned bit for bit if it satisfies the rows and the box.

        The kernel gets the rows that are violated most at u_nom, then the rows that its solution violates, until none
        is violated. A solution for some rows that satisfies all rows is the solution for all rows, and rows that
        conflict also conflict together with more rows.
        """
        if np.all(u_nom >= lower) and np.all(u_nom <= upper) and np.all(A @ u_nom >= b):
            return QpResult(u=u_nom.copy(), rows_met=True, limit_reached=False, iterations=0, active=())
        scaled, size = A * self.unit, row_norms(A * self.unit)
        chosen = np.zeros(len(b), bool)
        gap, total = (A @ np.clip(u_nom, lower, upper) - b) / size, 0
        while True:
            chosen[_worst_rows(gap)] = True
            at = np.flatnonzero(chosen)
            if len(at) > MAX_ROWS:
                return QpResult(u=u_nom.copy(), rows_met=False, limit_reached=True, iterations=total, active=())
            result, iterations, active, u = self._solve_rows(scaled[at], b[at], lower, upper, u_nom)
            total += iterations
            gap = (A @ u - b) / size
            if result != 0 or np.all(gap >= -ROW_TOLERANCE) or np.all(chosen[gap < -ROW_TOLERANCE]):
                break
        met = result == 0 and bool(np.all(gap >= -ROW_TOLERANCE))
        n = len(u)
        named = tuple((i if i < 2 * n else 2 * n + int(at[i - 2 * n]), weight) for i, weight in active)
        return QpResult(
            u=u, rows_met=met, limit_reached=result == 2 or (result == 0 and not met), iterations=total, active=named
        )

    def _solve_rows(
        self, scaled: Array, b: Array, lower: Array, upper: Array, u_nom: Array
    ) -> tuple[int, int, tuple[tuple[int, float], ...], Array]:
        solution = np.empty(len(u_nom))
        result, iterations, active = _kernel64.solve_qp(
            self._scale, scaled, b, lower / self.unit, upper / self.unit, u_nom / self.unit, solution
        )
        return result, iterations, active, np.clip(solution * self.unit, lower, upper)


def _worst_rows(gap: Array) -> NDArray[np.int64]:
    """The `ROWS_PER_CALL` rows with the smallest gaps, or all rows if there are fewer."""
    return np.argpartition(gap, ROWS_PER_CALL)[:ROWS_PER_CALL] if len(gap) > ROWS_PER_CALL else np.arange(len(gap))


def row_norms(rows: Array) -> Array:
    """Euclidean length of each row, at least 1e-9."""
    return np.maximum(np.linalg.norm(rows, axis=1), 1e-9)
