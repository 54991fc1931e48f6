"""Diverse retrieval: maximal marginal relevance (Carbonell & Goldstein 1998) over R."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dualbrain.errors import ConfigurationError
from dualbrain.memory.retrieval.search import FlatIndex, Mask, MemoryHit, QueryComparison, Weights

CANDIDATE_FACTOR = 8
"""The hits are chosen among this many times k candidates."""


def select_diverse(
    flat_index: FlatIndex,
    compared: QueryComparison,
    eligible: Mask,
    k: int,
    lambda_s: float,
    diversity: float,
    weights: Weights | None = None,
) -> tuple[MemoryHit, ...]:
    """`k` hits chosen one by one by the largest (1 − d)·R − d·max_j (1 + cos_j)/2, with d = `diversity` ∈ [0, 1].

    The maximum is over the hits j that were chosen before. Candidates are the 8k best rows by R; d = 0 is plain
    retrieval. The first hit is always the best by R, and ties go to the larger R. Near-duplicates of a chosen memory,
    which add nothing to a prompt, are ranked lower. Raises `ConfigurationError` for d outside [0, 1].
    """
    check_diversity(diversity)
    pool = list(flat_index.top_k(compared, eligible, CANDIDATE_FACTOR * k, lambda_s, weights))
    similarity = _pairwise_similarity(flat_index, compared, pool)
    chosen: list[int] = []
    while len(chosen) < min(k, len(pool)):
        remaining = [i for i in range(len(pool)) if i not in chosen]
        values = [
            (1.0 - diversity) * pool[i].score - diversity * max((similarity[i, j] for j in chosen), default=0.0)
            for i in remaining
        ]
        chosen.append(remaining[int(np.argmax(values))])
    return tuple(pool[i] for i in chosen)


def check_diversity(diversity: float) -> None:
    """Raise `ConfigurationError` unless d ∈ [0, 1]."""
    if not 0.0 <= diversity <= 1.0:
        raise ConfigurationError("diversity", got=diversity, allowed="in [0, 1]")


def _pairwise_similarity(
    flat_index: FlatIndex, compared: QueryComparison, pool: list[MemoryHit]
) -> NDArray[np.float64]:
    """(1 + cos)/2 of each pair in the pool, shape (n_pool, n_pool); the blocks are weighted as in the query."""
    if not pool:
        return np.zeros((0, 0))
    rows = np.array([hit.row for hit in pool])
    shares = compared.query.weight_by_mask
    blocks = flat_index.rows[rows].astype(np.float64)
    weighted = blocks * compared.query.scale
    both = shares[flat_index.masks[rows][:, None] & flat_index.masks[rows][None, :]]
    product = weighted @ blocks.T
    return (1.0 + np.divide(product, both, out=np.zeros_like(product), where=both > 0.0)) / 2.0
