"""When no control meets all rows: the one that violates them least, rank by rank, each rank as little as possible."""

from __future__ import annotations

import msgspec
import numpy as np
from numpy.typing import NDArray

from dualbrain.safety.cbf.qp import ControlQp, QpResult, row_norms

Array = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

MAX_NEWTON_STEPS = 40
"""Steps toward the least violation; each ends where the last certificate of conflict ends."""
MIN_ROW_NORM = 1e-9
"""A row shorter than this, in scaled controls, cannot be acted upon."""


class RelaxationProblem(msgspec.Struct, frozen=True, eq=False, kw_only=True):
    """Rows A u ≥ b in the box [lower, upper] that cannot all be met.

    `size` (m,) is the unit in which a row's violation counts, `anchor` (n,) an admissible control to stay near to,
    `floor` (m,) what each row keeps in any case; the anchor must meet it.
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
        """The control nearest to the anchor among those of least violation, and the ranks that were given up.

        Ranks come in rising order. Within a rank the largest violation (b − A u)/size is the least possible; the rows
        whose conflict determines it stay there, the others go on without them.
        """
        lengths = row_norms(self.A * self.qp.unit)
        kept = self.floor - 1e-9 * lengths
        dead = (lengths <= MIN_ROW_NORM) & (self.b > 0.0)
        given_up = {int(r) for r in rank[dead]}
        answer = self._solve_qp(kept)
        for which in np.unique(rank):
            mine = (rank == which) & ~dead
            while mine.any():
                answer, eased, lost = self._relax_rank(kept, mine, lengths)
                if not lost.any():
                    kept = np.minimum(eased, self.A @ answer.u)
                    break
                given_up.add(int(which))
                kept = np.where(lost, np.minimum(eased, self.A @ answer.u), kept)
                mine = mine & ~lost
        return answer, tuple(sorted(given_up))

    def _solve_qp(self, kept: Array) -> QpResult:
        return self.qp.solve(self.A, kept, self.lower, self.upper, self.reference)

    def _relax_rank(self, kept: Array, in_rank: BoolArray, lengths: Array) -> tuple[QpResult, Array, BoolArray]:
        """Ease the rows of `mine` by t times their size, no further than `kept`, with the least t that can be met.

        A Farkas certificate λ of a t that is too small says that t must grow until Σ λ (b − t size) ≤ 0: Newton's steps
        on the least t, from below. Also what all rows keep then, and which had to give.
        """
        t, conflict = 0.0, in_rank & False
        most = float(np.max((self.b - kept)[in_rank] / self.violation_unit[in_rank]))
        for _ in range(MAX_NEWTON_STEPS):
            wanted = self.b - t * self.violation_unit
            eased = np.where(in_rank, np.maximum(kept, wanted), kept)
            answer = self._solve_qp(eased)
            if answer.rows_met:
                return answer, eased, conflict
            weight = self._row_multipliers(answer, len(kept)) / lengths
            open_rows = in_rank & (wanted > kept)
            excess = float(weight @ eased) + self._box_certificate(answer)
            slope = float(weight[open_rows] @ self.violation_unit[open_rows])
            if answer.limit_reached or slope <= 0.0 or excess <= 0.0:
                break
            conflict = open_rows & (weight > 0.0)
            t = min(most, t + excess / slope * (1.0 + 1e-9) + 1e-9)
        eased = kept.copy()
        return self._solve_qp(eased), eased, in_rank

    def _row_multipliers(self, answer: QpResult, m: int) -> Array:
        """Multipliers of the rows (m,) in a certificate."""
        weights, first = np.zeros(m), 2 * len(self.reference)
        for index, weight in answer.active:
            if index >= first:
                weights[index - first] = max(weight, 0.0)
        return weights

    def _box_certificate(self, answer: QpResult) -> float:
        """The box's part of a certificate, in scaled controls."""
        bounds = np.concatenate([self.lower / self.qp.unit, -self.upper / self.qp.unit])
        return sum(max(weight, 0.0) * float(bounds[index]) for index, weight in answer.active if index < len(bounds))


def floor_at_control(A: Array, b: Array, control: Array) -> Array:
    """The floor of rows that are not to be met worse than `control` meets them, unless beyond their own b."""
    return np.minimum(b, A @ control)


def floor_in_box(A: Array, b: Array, lower: Array, upper: Array) -> Array:
    """The floor of rows of which nothing is kept: what every control in the box meets."""
    return np.minimum(b, np.minimum(A * lower, A * upper).sum(axis=1))
