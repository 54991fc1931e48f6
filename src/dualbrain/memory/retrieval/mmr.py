"""Diverse retrieval: maximal marginal relevance (Carbonell & Goldstein 1998) over R."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dualbrain.errors import ConfigurationError
from dualbrain.memory.retrieval.search import FlatIndex, Mask, MemoryHit, QueryComparison, Weights

CANDIDATE_FACTOR = 8
"""How many times k candidates are considered."""


def select_diverse(
    scan: FlatIndex,
    compared: QueryComparison,
    eligible: Mask,
    k: int,
    lambda_s: float,
    diversity: float,
    weights: Weights | None = None,
) -> tuple[MemoryHit, ...]:
    """K hits chosen one by one by (1 − d)·R − d·max (1 + cos)/2 to those chosen before, d = `diversity` ∈ [0, 1].

    Chosen among the 8k best by R; d = 0 is plain retrieval. The first hit is always the best by R; ties go to the
    better R. Near-duplicates of a chosen memory, which add nothing to a prompt, fall behind.
    """
    if not 0.0 <= diversity <= 1.0:
        raise ConfigurationError("diversity", got=diversity, allowed="in [0, 1]")
    pool = list(scan.top_k(compared, eligible, CANDIDATE_FACTOR * k, lambda_s, weights))
    likeness = _pairwise_similarity(scan, compared, pool)
    chosen: list[int] = []
    while len(chosen) < min(k, len(pool)):
        left = [i for i in range(len(pool)) if i not in chosen]
        values = [
            (1.0 - diversity) * pool[i].score - diversity * max((likeness[i, j] for j in chosen), default=0.0)
            for i in left
        ]
        chosen.append(left[int(np.argmax(values))])
    return tuple(pool[i] for i in chosen)


def _pairwise_similarity(scan: FlatIndex, compared: QueryComparison, pool: list[MemoryHit]) -> NDArray[np.float64]:
    """(1 + cos)/2 of each pair in the pool, the blocks weighted as in the query."""
    if not pool:
        return np.zeros((0, 0))
    rows = np.array([hit.row for hit in pool])
    shares = compared.query.weight_by_mask
    blocks = scan.rows[rows].astype(np.float64)
    weighted = blocks * compared.query.scale
    both = shares[scan.masks[rows][:, None] & scan.masks[rows][None, :]]
    product = weighted @ blocks.T
    return (1.0 + np.divide(product, both, out=np.zeros_like(product), where=both > 0.0)) / 2.0
