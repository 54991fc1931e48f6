"""Feedback-weighted retrieval (paper 5.2): the exact top k of R = λ_s s + (1 − λ_s) w̄ by a scan over all memories.

w̄ combines the weights of all memories of a contract near the query (`contract_weights`); for a contract with a single
memory, w̄ is the weight w of this memory.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dualbrain.core.encoder import Float32Array
from dualbrain.errors import ConfigurationError
from dualbrain.memory.plasticity.hebbian_update import W0

Mask = NDArray[np.bool_]
RowNumbers = NDArray[np.intp]
Weights = NDArray[np.float64]
Codes = NDArray[np.int32]


@dataclass(frozen=True, slots=True)
class MemoryHit:
    """One retrieved row: its number, similarity s ∈ [0, 1], the weight w̄ ∈ [0, 1] of its contract and score R."""

    row: int
    similarity: float
    weight: float
    score: float


@dataclass(frozen=True, slots=True)
class Query:
    """A query: `vector` [α_b v_b] of shape (dim,) and the `mask` of its blocks.

    `weight_by_mask` is Σ_b α_b over the blocks of each mask, shape (n_masks,); `scale` is α_b repeated over the entries
    of block b, shape (dim,).
    """

    vector: Float32Array
    mask: int
    weight_by_mask: NDArray[np.float64]
    scale: Float32Array

    @classmethod
    def single_block(cls, row: Float32Array) -> Query:
        """A query with one block."""
        return cls(row, 1, np.array([0.0, 1.0]), np.ones_like(row))


@dataclass(frozen=True, slots=True)
class QueryComparison:
    """A query and its cosine with every row, shape (n,), float32."""

    query: Query
    cosine: Float32Array


class FlatIndex:
    """All embeddings in one float32 matrix of shape (n, dim), with weights and block masks of shape (n,).

    A robot collects 1e4 to 1e5 episodes in years. Up to this size a scan over all rows runs at memory bandwidth and is
    exact, whereas an approximate search by similarity alone misses most of the true top k of R.
    """

    def __init__(self, dim: int) -> None:
        """Create an index without rows, for embeddings of length `dim`."""
        self._rows: Float32Array = np.empty((0, dim), np.float32)
        self._weights = np.empty(0)
        self._masks: NDArray[np.uint8] = np.empty(0, np.uint8)
        self._count = 0
        self._common_mask: int | None = None
        self._scratch: tuple[Float32Array, Float32Array] = (np.empty(0, np.float32), np.empty(0, np.float32))

    def __len__(self) -> int:
        return self._count

    @property
    def rows(self) -> Float32Array:
        """All embeddings, shape (n, dim); read-only."""
        return self._rows[: self._count]

    @property
    def masks(self) -> NDArray[np.uint8]:
        """Mask of the blocks of each row, shape (n,)."""
        return self._masks[: self._count]

    def load(self, rows: Float32Array, weights: NDArray[np.float64], masks: NDArray[np.uint8]) -> None:
        """Replace all rows, weights and masks by these arrays of shapes (n, dim), (n,) and (n,)."""
        self._rows, self._weights, self._masks, self._count = rows, weights, masks, len(rows)
        found = np.unique(masks)
        self._common_mask = int(found[0]) if found.size == 1 else None

    def add(self, embedding: Float32Array, weight: float, mask: int = 1) -> int:
        """Append one row of shape (dim,) and return its number; later rows are newer."""
        if self._count == len(self._rows):
            growth = max(64, len(self._rows) // 2)
            self._rows = np.concatenate([self._rows, np.empty((growth, self._rows.shape[1]), np.float32)])
            self._weights = np.concatenate([self._weights, np.empty(growth)])
            self._masks = np.concatenate([self._masks, np.empty(growth, np.uint8)])
        self._rows[self._count], self._weights[self._count], self._masks[self._count] = embedding, weight, mask
        self._common_mask = mask if self._count == 0 or self._common_mask == mask else None
        self._count += 1
        return self._count - 1

    def weight(self, row: int) -> float:
        """The weight w of one row."""
        return float(self._weights[row])

    def set_weight(self, row: int, weight: float) -> None:
        """Set the weight w of one row."""
        self._weights[row] = weight

    def compare(self, query: Query) -> QueryComparison:
        """Compute the cosine with every row; the result is valid for `top_k` until a row is added."""
        product = self.rows @ query.vector
        if self._common_mask is not None:
            share = query.weight_by_mask[self._common_mask & query.mask]
            if abs(share - 1.0) > 1e-6:
                product *= np.float32(1.0 / share if share else 0.0)
            return QueryComparison(query, product)
        shares = query.weight_by_mask[self.masks & query.mask].astype(np.float32)
        return QueryComparison(query, np.divide(product, shares, out=np.zeros_like(product), where=shares > 0.0))

    @property
    def weights(self) -> Weights:
        """The weight of each row, shape (n,); read-only."""
        return self._weights[: self._count]

    def top_k(
        self, compared: QueryComparison, eligible: Mask, k: int, lambda_s: float, weights: Weights | None = None
    ) -> tuple[MemoryHit, ...]:
        """The k eligible rows with the largest R = λ_s (1 + cos)/2 + (1 − λ_s) w, best first; ties: newest first.

        `weights`, shape (n,), replace the weights of the rows. The scan is in float32; every row within the rounding
        error of the k-th is scored again in float64, row by row. The answer therefore equals that of a float64 sort,
        and equal rows tie exactly, independent of their position. Raises `ConfigurationError` for λ_s outside [0, 1].
        """
        check_lambda(lambda_s)
        n = self._count
        if k <= 0 or n == 0:
            return ()
        if len(self._scratch[0]) < n:
            self._scratch = (np.empty(len(self._rows), np.float32), np.empty(len(self._rows), np.float32))
        rough, sorting = (part[:n] for part in self._scratch)
        np.multiply(compared.cosine, np.float32(lambda_s / 2.0), out=rough)
        weights = self.weights if weights is None else weights
        np.multiply(weights, 1.0 - lambda_s, out=sorting, casting="same_kind")
        rough += sorting
        np.copyto(rough, -np.inf, where=~eligible)
        np.copyto(sorting, rough)
        sorting.partition(max(0, n - k))
        rows = np.flatnonzero(rough >= sorting[max(0, n - k)] - self._rounding_bound(compared.query))
        return self._rank(rows[eligible[rows]], compared.query, lambda_s, weights)[:k]

    def _rounding_bound(self, query: Query) -> float:
        """Bound on the rounding error of a float32 score."""
        present = query.weight_by_mask[query.weight_by_mask > 0.0]
        least = min(1.0, float(present.min())) if present.size else 1.0
        return (2.0 * query.vector.size / least + 8.0) * 2.0**-24

    def _rank(self, rows: RowNumbers, query: Query, lambda_s: float, weights: Weights) -> tuple[MemoryHit, ...]:
        cosine = self.cosines(rows, query)
        similarity = np.clip((1.0 + cosine) / 2.0, 0.0, 1.0)
        weights = weights[rows]
        score = lambda_s * similarity + (1.0 - lambda_s) * weights
        order = np.lexsort((-rows, -score))
        return tuple(MemoryHit(int(rows[i]), float(similarity[i]), float(weights[i]), float(score[i])) for i in order)

    def cosines(self, rows: RowNumbers, query: Query) -> NDArray[np.float64]:
        """The cosine of some rows with the query in float64, each computed on its own, shape (n_rows,)."""
        product = (self._rows[rows].astype(np.float64) * query.vector.astype(np.float64)).sum(axis=1)
        shares = query.weight_by_mask[self._masks[rows] & query.mask]
        return np.divide(product, shares, out=np.zeros_like(product), where=shares > 0.0)


def contract_weights(
    compared: QueryComparison, weights: Weights, contract_codes: Codes, counted: Mask, bandwidth: float
) -> Weights:
    """The weight w̄ of each row's contract near the query, shape (n,): the evidence of its memories is summed.

    w̄ = min{1, max{0, w₀ + Σ_j κ_j (w_j − w₀)}} over the `counted` rows j of the same contract (equal codes in
    `contract_codes`, shape (n,)). The nearest of these rows has κ = 1, the others κ_j = exp(−(d_j² − d²)/2ℓ²) with
    d_j² = ‖e_j − e_q‖² = 2 − 2 cos_j, d the distance of the nearest row, and ℓ = `bandwidth`. A contract with a single
    memory thus has the weight of this memory; rows of a contract without counted rows keep their own weights.

    The sum is needed because a repeated contract is not a new one: on its own, its newest memory would start at w₀,
    however often the contract had failed before.
    """
    n_contracts = int(contract_codes.max(initial=-1)) + 1
    cosine = np.where(counted, compared.cosine, np.float32(-np.inf))
    nearest = np.full(n_contracts, -np.inf, np.float32)
    np.maximum.at(nearest, contract_codes, cosine)
    known = np.isfinite(nearest)[contract_codes]
    gap = np.subtract(cosine, nearest[contract_codes], out=np.full_like(cosine, -np.inf), where=known)
    kernel = np.exp(gap / np.float32(bandwidth**2))
    evidence = np.bincount(contract_codes, kernel * (weights - W0), n_contracts)
    return np.where(known, np.clip(W0 + evidence[contract_codes], 0.0, 1.0), weights)


def check_lambda(lambda_s: float) -> None:
    """Raise `ConfigurationError` unless λ_s ∈ [0, 1]."""
    if not 0.0 <= lambda_s <= 1.0:
        raise ConfigurationError("lambda_s", got=lambda_s, allowed="in [0, 1]")
