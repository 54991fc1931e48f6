"""Two rankings become one: by words (BM25) and by meaning (cosine)."""

from __future__ import annotations

from collections.abc import Mapping

SHARE = 0.7
"""Share of meaning in the fused score; docs/knowledge.md has the measurement."""


def normalised(words: Mapping[int, float], meaning: Mapping[int, float], share: float = SHARE) -> dict[int, float]:
    """score(d) = (1 − share) bm25(d)/max bm25 + share max(0, cos(d)): absolute in meaning, relative in words."""
    best = max(words.values(), default=0.0)
    return {
        item: (1.0 - share) * (words.get(item, 0.0) / best if best > 0.0 else 0.0)
        + share * max(0.0, meaning.get(item, 0.0))
        for item in {*words, *meaning}
    }
