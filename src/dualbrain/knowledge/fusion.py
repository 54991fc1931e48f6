"""Two rankings become one: by words (BM25) and by meaning (cosine)."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

SHARE = 0.7
"""Share of meaning in the fused score; docs/knowledge.md has the measurement."""
RANK_OFFSET = 60
"""k of reciprocal rank fusion: how little the very first ranks stand out."""


def reciprocal_ranks(rankings: Sequence[Iterable[int]], k: int = RANK_OFFSET) -> dict[int, float]:
    """score(d) = Σ_r 1/(k + rank_r(d)), ranks from 1 (Cormack, Clarke and Büttcher, SIGIR 2009).

    Needs no calibration between scores of different kinds; what only one ranking holds is not excluded.
    """
    scores: dict[int, float] = {}
    for ranking in rankings:
        for rank, item in enumerate(ranking, start=1):
            scores[item] = scores.get(item, 0.0) + 1.0 / (k + rank)
    return scores


def normalised(words: Mapping[int, float], meaning: Mapping[int, float], share: float = SHARE) -> dict[int, float]:
    """score(d) = (1 − share) bm25(d)/max bm25 + share max(0, cos(d)): absolute in meaning, relative in words."""
    best = max(words.values(), default=0.0)
    return {
        item: (1.0 - share) * (words.get(item, 0.0) / best if best > 0.0 else 0.0)
        + share * max(0.0, meaning.get(item, 0.0))
        for item in {*words, *meaning}
    }
