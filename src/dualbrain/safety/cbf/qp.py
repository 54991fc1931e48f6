"""The closest control that meets every row: the kernel's QP in float64, for any number of rows."""

from __future__ import annotations

import msgspec
import numpy as np
from numpy.typing import NDArray

from dualbrain.errors import ConfigurationError
from dualbrain.safety.cbf.compiled import _kernel64

Array = NDArray[np.float64]

MAX_CONTROLS = 8
"""Controls that the kernel's QP holds."""
MAX_ROWS = 512
"""Rows that the kernel's QP holds; more may be given, of which it needs few."""
ROWS_PER_CALL = 48
"""Rows that are handed to the kernel at a time."""
ROW_TOLERANCE = 1e-8
"""What the check after the QP forgives in a row, as a share of the row's own size."""


class QpResult(msgspec.Struct, frozen=True, eq=False, kw_only=True):
    """Answer of one QP: `u` (n,), whether all rows are met, and its active constraints.

    `active` are (index, multiplier): 0..n−1 lower bounds, n..2n−1 upper bounds, then rows; when rows conflict they are
    the members of a Farkas certificate. `capped` says that the QP gave up: u is then no answer.
    """

    u: Array
    rows_met: bool
    limit_reached: bool
    iterations: int
    active: tuple[tuple[int, float], ...]


class ControlQp:
    """min ½‖u − u_nom‖²_R  s.t.  A u ≥ b, lower ≤ u ≤ upper, in controls scaled by `unit` (paper 4.3).

    Promise: an answer that is `met` has passed a check of box and rows that shares nothing with the solver.
    """

    def __init__(self, unit: Array, weight: Array | None = None) -> None:
        """`unit` (n,) is the size of each control; `weight` is R (n, n), by default diag(1/unit²)."""
        self.unit, n = unit, len(unit)
        if not 1 <= n <= MAX_CONTROLS:
            raise ConfigurationError("controls", got=n, allowed=f"1 to {MAX_CONTROLS}, which the kernel's QP holds")
        R = np.eye(n) if weight is None else unit[:, None] * np.asarray(weight, float) * unit
        try:
            self._scale = np.array(np.linalg.inv(np.linalg.cholesky(R)).T, np.float64, order="C")
        except np.linalg.LinAlgError:
            raise ConfigurationError("weight R", got=weight, allowed="symmetric positive definite") from None

    def solve(self, A: Array, b: Array, lower: Array, upper: Array, u_nom: Array) -> QpResult:
        """The closest control to u_nom (n,), which is returned bit for bit where it meets rows and box.

        The kernel is given the rows that are worst at u_nom, then those that its answer breaks, until it breaks none:
        an optimum over some rows that meets all is the optimum over all, and rows that conflict do so among more.
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
        answer = np.empty(len(u_nom))
        result, iterations, active = _kernel64.solve_qp(
            self._scale, scaled, b, lower / self.unit, upper / self.unit, u_nom / self.unit, answer
        )
        return result, iterations, active, np.clip(answer * self.unit, lower, upper)


def _worst_rows(gap: Array) -> NDArray[np.int64]:
    """The rows with the smallest gaps: those below zero and their nearest, at most `BATCH`."""
    return np.argpartition(gap, ROWS_PER_CALL)[:ROWS_PER_CALL] if len(gap) > ROWS_PER_CALL else np.arange(len(gap))


def row_norms(rows: Array) -> Array:
    """Euclidean length of each row, at least 1e-9."""
    return np.maximum(np.linalg.norm(rows, axis=1), 1e-9)
