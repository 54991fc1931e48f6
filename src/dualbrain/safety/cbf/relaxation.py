"""When no control meets all rows: the one that violates them least, rank by rank, each rank as little as possible."""

from __future__ import annotations

import msgspec
import numpy as np
from numpy.typing import NDArray

from dualbrain.safety.cbf.qp import Closest, ClosestControl, row_sizes

Array = NDArray[np.float64]
Marks = NDArray[np.bool_]

ROUNDS = 40
"""Steps toward the least violation; each ends where the last certificate of conflict ends."""
DEAD = 1e-9
"""A row shorter than this, in scaled controls, cannot be acted upon."""


class Conflict(msgspec.Struct, frozen=True, eq=False):
    """Rows A u ≥ b in the box [lower, upper] that cannot all be met.

    `size` (m,) is the unit in which a row's violation counts, `anchor` (n,) an admissible control to stay near to,
    `floor` (m,) what each row keeps in any case; the anchor must meet it.
    """

    closest: ClosestControl
    A: Array
    b: Array
    size: Array
    lower: Array
    upper: Array
    anchor: Array
    floor: Array

    def least(self, rank: NDArray[np.int64]) -> tuple[Closest, tuple[int, ...]]:
        """The control nearest to the anchor among those of least violation, and the ranks that were given up.

        Ranks come in rising order. Within a rank the largest violation (b − A u)/size is the least possible; the rows
        whose conflict determines it stay there, the others go on without them.
        """
        lengths = row_sizes(self.A * self.closest.unit)
        kept = self.floor - 1e-9 * lengths
        dead = (lengths <= DEAD) & (self.b > 0.0)
        given_up = {int(r) for r in rank[dead]}
        answer = self._nearest(kept)
        for which in np.unique(rank):
            mine = (rank == which) & ~dead
            while mine.any():
                answer, eased, lost = self._ease(kept, mine, lengths)
                if not lost.any():
                    kept = np.minimum(eased, self.A @ answer.u)
                    break
                given_up.add(int(which))
                kept = np.where(lost, np.minimum(eased, self.A @ answer.u), kept)
                mine = mine & ~lost
        return answer, tuple(sorted(given_up))

    def _nearest(self, kept: Array) -> Closest:
        return self.closest.solve(self.A, kept, self.lower, self.upper, self.anchor)

    def _ease(self, kept: Array, mine: Marks, lengths: Array) -> tuple[Closest, Array, Marks]:
        """Ease the rows of `mine` by t times their size, no further than `kept`, with the least t that can be met.

        A Farkas certificate λ of a t that is too small says that t must grow until Σ λ (b − t size) ≤ 0: Newton's steps
        on the least t, from below. Also what all rows keep then, and which had to give.
        """
        t, conflict = 0.0, mine & False
        most = float(np.max((self.b - kept)[mine] / self.size[mine]))
        for _ in range(ROUNDS):
            wanted = self.b - t * self.size
            eased = np.where(mine, np.maximum(kept, wanted), kept)
            answer = self._nearest(eased)
            if answer.met:
                return answer, eased, conflict
            weight = self._weights(answer, len(kept)) / lengths
            open_rows = mine & (wanted > kept)
            excess = float(weight @ eased) + self._box(answer)
            slope = float(weight[open_rows] @ self.size[open_rows])
            if answer.capped or slope <= 0.0 or excess <= 0.0:
                break
            conflict = open_rows & (weight > 0.0)
            t = min(most, t + excess / slope * (1.0 + 1e-9) + 1e-9)
        eased = kept.copy()
        return self._nearest(eased), eased, mine

    def _weights(self, answer: Closest, m: int) -> Array:
        """Multipliers of the rows (m,) in a certificate."""
        weights, first = np.zeros(m), 2 * len(self.anchor)
        for index, weight in answer.active:
            if index >= first:
                weights[index - first] = max(weight, 0.0)
        return weights

    def _box(self, answer: Closest) -> float:
        """The box's part of a certificate, in scaled controls."""
        bounds = np.concatenate([self.lower / self.closest.unit, -self.upper / self.closest.unit])
        return sum(max(weight, 0.0) * float(bounds[index]) for index, weight in answer.active if index < len(bounds))


def above(A: Array, b: Array, control: Array) -> Array:
    """The floor of rows that are not to be met worse than `control` meets them, unless beyond their own b."""
    return np.minimum(b, A @ control)


def anywhere(A: Array, b: Array, lower: Array, upper: Array) -> Array:
    """The floor of rows of which nothing is kept: what every control in the box meets."""
    return np.minimum(b, np.minimum(A * lower, A * upper).sum(axis=1))
