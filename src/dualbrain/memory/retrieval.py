"""Feedback-weighted retrieval (paper 5.2): the exact top k of R = λ_s s + (1 − λ_s) w by a scan over all memories."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dualbrain.errors import InvalidSetup
from dualbrain.memory.encoder import Rows

Mask = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Hit:
    """One retrieved row: its number, similarity s ∈ [0, 1], weight w ∈ [0, 1] and score R."""

    row: int
    similarity: float
    weight: float
    score: float


@dataclass(frozen=True, slots=True)
class Compared:
    """A query of shape (dim,) and its cosine with every row, shape (n,), in float32."""

    query: Rows
    cosine: Rows


class Scan:
    """All embeddings in one float32 matrix of shape (n, dim), all weights beside it.

    A robot makes 1e4 to 1e5 episodes in years; up to there reading every row is as fast as memory allows, and it is
    exact, while over-fetching by similarity misses most of the true top k of R.
    """

    def __init__(self, dim: int) -> None:
        """Begin empty, for embeddings of length `dim`."""
        self._rows: Rows = np.empty((0, dim), np.float32)
        self._weights = np.empty(0)
        self._count = 0

    def __len__(self) -> int:
        return self._count

    def add(self, embedding: Rows, weight: float) -> int:
        """Append one unit row of shape (dim,); returns its number. Later rows are newer."""
        if self._count == len(self._rows):
            room = max(64, len(self._rows))
            self._rows = np.concatenate([self._rows, np.empty((room, self._rows.shape[1]), np.float32)])
            self._weights = np.concatenate([self._weights, np.empty(room)])
        self._rows[self._count], self._weights[self._count] = embedding, weight
        self._count += 1
        return self._count - 1

    def weight(self, row: int) -> float:
        """Weight w of one row."""
        return float(self._weights[row])

    def reweigh(self, row: int, weight: float) -> None:
        """Set w of one row."""
        self._weights[row] = weight

    def compare(self, query: Rows) -> Compared:
        """Read every row once; the result serves any number of `top` calls until a row is added."""
        return Compared(query, self._rows[: self._count] @ query)

    def top(self, compared: Compared, eligible: Mask, k: int, lambda_s: float) -> tuple[Hit, ...]:
        """The k eligible rows with the largest R = λ_s (1 + cos)/2 + (1 − λ_s) w, best first; the newer wins a tie.

        The scan is in float32; every row within its rounding error of the k-th is scored again in float64, row by row,
        so the answer equals that of a float64 sort, and equal rows tie exactly wherever they stand.
        """
        check_lambda(lambda_s)
        query, rows = compared.query, np.flatnonzero(eligible)
        if k <= 0 or rows.size == 0:
            return ()
        rough = lambda_s * (1.0 + compared.cosine[rows]) / 2.0 + (1.0 - lambda_s) * self._weights[rows]
        rows = rows[rough >= _kth(rough, k) - 2.0 * query.size * 2.0**-24]
        return self._ranked(rows, query, lambda_s)[:k]

    def _ranked(self, rows: NDArray[np.intp], query: Rows, lambda_s: float) -> tuple[Hit, ...]:
        cosine = (self._rows[rows].astype(np.float64) * query.astype(np.float64)).sum(axis=1)
        similarity = np.clip((1.0 + cosine) / 2.0, 0.0, 1.0)
        weights = self._weights[rows]
        score = lambda_s * similarity + (1.0 - lambda_s) * weights
        order = np.lexsort((-rows, -score))
        return tuple(Hit(int(rows[i]), float(similarity[i]), float(weights[i]), float(score[i])) for i in order)


def check_lambda(lambda_s: float) -> None:
    """Raise `InvalidSetup` unless λ_s ∈ [0, 1]."""
    if not 0.0 <= lambda_s <= 1.0:
        raise InvalidSetup("lambda_s", got=lambda_s, allowed="in [0, 1]")


def _kth(values: NDArray[np.floating], k: int) -> float:
    """The k-th largest value, the smallest if there are fewer."""
    return float(np.partition(values, -k)[-k]) if k < values.size else float(values.min())
