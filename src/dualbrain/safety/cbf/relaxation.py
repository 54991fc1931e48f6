"""Lexicographic relaxation: if no control satisfies all rows, violate them rank by rank, each as little as possible."""

from __future__ import annotations

import msgspec
import numpy as np
from numpy.typing import NDArray

from dualbrain.safety.cbf.qp import ControlQp, QpResult, row_norms

Array = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

MAX_NEWTON_STEPS = 40
"""Most Newton steps toward the least violation of a rank."""
MIN_ROW_NORM = 1e-9
"""Rows with a smaller norm, in scaled controls, cannot be influenced by the controls."""


class RelaxationProblem(msgspec.Struct, frozen=True, eq=False, kw_only=True):
    """Rows A u ≥ b in the box [lower, upper] that no control satisfies together.

    `violation_unit` (m,) is the unit in which the violation of a row counts. `reference` (n,) is an admissible control;
    the solution stays close to it. `floor` (m,) is the right-hand side that each row keeps in any case; the reference
    must satisfy it.
    """

    qp: ControlQp
    A: Array
    b: Array
    violation_unit: Array
    lower: Array
    upper: Array
    reference: Array
    floor: Array

    def solve(self, rank: NDArray[np.int64]) -> tuple[QpResult, tuple[int, ...]]:
        """The control closest to the reference among those of least violation, and the ranks that were relaxed.

        `rank` (m,) is the rank of each row. Ranks are processed in increasing order. Within a rank the largest
        violation (b − A u)/violation_unit is minimal; the rows whose conflict determines it stay at that violation, and
        the others are processed again without them.
        """
        lengths = row_norms(self.A * self.qp.unit)
        kept = self.floor - 1e-9 * lengths
        inert = (lengths <= MIN_ROW_NORM) & (self.b > 0.0)
        relaxed = {int(r) for r in rank[inert]}
        result = self._solve_qp(kept)
        for which in np.unique(rank):
            in_rank = (rank == which) & ~inert
            while in_rank.any():
                result, eased, violated = self._relax_rank(kept, in_rank, lengths)
                if not violated.any():
                    kept = np.minimum(eased, self.A @ result.u)
                    break
                relaxed.add(int(which))
                kept = np.where(violated, np.minimum(eased, self.A @ result.u), kept)
                in_rank = in_rank & ~violated
        return result, tuple(sorted(relaxed))

    def _solve_qp(self, kept: Array) -> QpResult:
        return self.qp.solve(self.A, kept, self.lower, self.upper, self.reference)

    def _relax_rank(self, kept: Array, in_rank: BoolArray, lengths: Array) -> tuple[QpResult, Array, BoolArray]:
        """Relax the rows of a rank by t violation units, at most down to `kept`, with the least feasible t.

        A Farkas certificate λ for a t that is too small shows that t must grow until Σ λ (b − t violation_unit) ≤ 0.
        These are Newton steps on the least t, from below. Returns the solution, the right-hand sides of all rows, and
        the rows that were relaxed.
        """
        t, conflict = 0.0, in_rank & False
        most = float(np.max((self.b - kept)[in_rank] / self.violation_unit[in_rank]))
        for _ in range(MAX_NEWTON_STEPS):
            wanted = self.b - t * self.violation_unit
            eased = np.where(in_rank, np.maximum(kept, wanted), kept)
            result = self._solve_qp(eased)
            if result.rows_met:
                return result, eased, conflict
            weight = self._row_multipliers(result, len(kept)) / lengths
            open_rows = in_rank & (wanted > kept)
            excess = float(weight @ eased) + self._box_certificate(result)
            slope = float(weight[open_rows] @ self.violation_unit[open_rows])
            if result.limit_reached or slope <= 0.0 or excess <= 0.0:
                break
            conflict = open_rows & (weight > 0.0)
            t = min(most, t + excess / slope * (1.0 + 1e-9) + 1e-9)
        eased = kept.copy()
        return self._solve_qp(eased), eased, in_rank

    def _row_multipliers(self, result: QpResult, m: int) -> Array:
        """Multipliers (m,) of the rows in a certificate."""
        weights, first = np.zeros(m), 2 * len(self.reference)
        for index, weight in result.active:
            if index >= first:
                weights[index - first] = max(weight, 0.0)
        return weights

    def _box_certificate(self, result: QpResult) -> float:
        """Contribution of the box to a certificate, in scaled controls."""
        bounds = np.concatenate([self.lower / self.qp.unit, -self.upper / self.qp.unit])
        return sum(max(weight, 0.0) * float(bounds[index]) for index, weight in result.active if index < len(bounds))


def floor_at_control(A: Array, b: Array, control: Array) -> Array:
    """Floor at which no row is violated more than by `control`: min(b, A·control)."""
    return np.minimum(b, A @ control)


def floor_in_box(A: Array, b: Array, lower: Array, upper: Array) -> Array:
    """Floor that every control in the box satisfies, so that rows may be relaxed without limit."""
    return np.minimum(b, np.minimum(A * lower, A * upper).sum(axis=1))
