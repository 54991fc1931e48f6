"""Retrieval against a brute-force oracle in float64, ties, and the parts of the score."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dualbrain.errors import ConfigurationError
from dualbrain.memory.retrieval.search import FlatIndex, MemoryHit, Query, contract_weights
from tests.memory.memory_samples import unit_rows

DIM = 24


def _filled(rows: np.ndarray, weights: np.ndarray) -> FlatIndex:
    index = FlatIndex(rows.shape[1])
    for row, weight in zip(rows, weights, strict=True):
        index.add(row, float(weight))
    return index


def _top(index: FlatIndex, query: np.ndarray, eligible: np.ndarray, k: int, lambda_s: float) -> tuple[MemoryHit, ...]:
    return index.top_k(index.compare(Query.single_block(query)), eligible, k, lambda_s)


def _oracle(rows, weights, query, eligible, k, lambda_s) -> list[int]:
    """Sort all rows in float64, one dot product at a time; the newest first among equals."""
    scored = []
    for i in np.flatnonzero(eligible):
        cosine = float((rows[i].astype(float) * query.astype(float)).sum())
        similarity = min(1.0, max(0.0, (1.0 + cosine) / 2.0))
        scored.append((-(lambda_s * similarity + (1.0 - lambda_s) * weights[i]), -i))
    return [-i for _, i in sorted(scored)[:k]]


@given(
    seed=st.integers(0, 10_000),
    n=st.integers(0, 150),
    k=st.integers(0, 12),
    lambda_s=st.sampled_from((0.0, 0.5, 0.8, 1.0)),
    distinct=st.integers(1, 40),
    levels=st.integers(1, 6),
)
def test_top_k_equals_the_oracle(seed: int, n: int, k: int, lambda_s: float, distinct: int, levels: int) -> None:
    """Few distinct rows and weights, so that ties are frequent."""
    rng = np.random.default_rng(seed)
    rows = unit_rows(rng, distinct, DIM)[rng.integers(0, distinct, n)]
    weights = rng.integers(0, levels, n) / max(1, levels - 1)
    query, eligible = unit_rows(rng, 1, DIM)[0], rng.random(n) < 0.7
    hits = _top(_filled(rows, weights), query, eligible, k, lambda_s)
    assert [hit.row for hit in hits] == _oracle(rows, weights, query, eligible, k, lambda_s)


def test_scores_too_close_for_float32_are_still_ranked_right() -> None:
    rng = np.random.default_rng(3)
    query = unit_rows(rng, 1, 900)[0]
    near = query + 1e-5 * rng.standard_normal((500, 900))
    rows = (near / np.linalg.norm(near, axis=1, keepdims=True)).astype(np.float32)
    weights = np.full(500, 0.5)
    naive = np.argsort(-(rows @ query), kind="stable")[:5]
    expected = _oracle(rows, weights, query, np.ones(500, bool), 5, 0.8)
    assert list(naive) != expected
    assert [hit.row for hit in _top(_filled(rows, weights), query, np.ones(500, bool), 5, 0.8)] == expected


def test_the_score_is_that_of_the_paper() -> None:
    a, b = np.eye(2, dtype=np.float32)
    index = _filled(np.stack([a, b]), np.array([0.25, 1.0]))
    first, second = _top(index, a, np.ones(2, bool), 2, 0.8)
    assert (first.row, first.similarity, first.weight) == (0, 1.0, 0.25)
    assert first.score == pytest.approx(0.8 * 1.0 + 0.2 * 0.25)
    assert second.score == pytest.approx(0.8 * 0.5 + 0.2 * 1.0)


@given(
    seed=st.integers(0, 10_000), n=st.integers(1, 40), kinds=st.integers(1, 8), bandwidth=st.sampled_from((0.05, 0.3))
)
def test_the_evidence_about_a_contract_is_summed_over_its_memories(
    seed: int, n: int, kinds: int, bandwidth: float
) -> None:
    """Brute force in Python floats; a contract with a single memory has the weight of this memory."""
    rng = np.random.default_rng(seed)
    rows, weights = unit_rows(rng, n, DIM), rng.random(n)
    contracts, counted = rng.integers(kinds, size=n).astype(np.int32), rng.random(n) < 0.7
    compared = _filled(rows, weights).compare(Query.single_block(unit_rows(rng, 1, DIM)[0]))
    result = contract_weights(compared, weights, contracts, counted, bandwidth)
    for i in range(n):
        same = [j for j in range(n) if contracts[j] == contracts[i] and counted[j]]
        distances = [2.0 - 2.0 * float(compared.cosine[j]) for j in same]
        shares = [np.exp((min(distances) - d) / (2.0 * bandwidth**2)) for d in distances]
        known = 0.5 + sum(share * (weights[j] - 0.5) for share, j in zip(shares, same, strict=True))
        expected = min(1.0, max(0.0, known)) if same else weights[i]
        assert result[i] == pytest.approx(expected, abs=1e-4)
        if same == [i]:
            assert result[i] == pytest.approx(weights[i], abs=1e-12)


def test_weights_outrank_similarity_within_the_stated_gap() -> None:
    """A weight gap of 1 outweighs a similarity gap below (1 - lambda)/lambda."""
    query = np.array([1.0, 0.0], np.float32)
    for gap, winner in ((0.24, 1), (0.26, 0)):
        cosine = 1.0 - 2.0 * gap
        far = np.array([cosine, np.sqrt(1.0 - cosine**2)], np.float32)
        index = _filled(np.stack([query, far]), np.array([0.0, 1.0]))
        assert _top(index, query, np.ones(2, bool), 1, 0.8)[0].row == winner


def test_changed_weights_change_the_ranking() -> None:
    rows = np.repeat(np.eye(1, 4, dtype=np.float32), 3, axis=0)
    index = _filled(rows, np.array([0.5, 0.5, 0.5]))
    index.set_weight(0, 0.9)
    index.set_weight(2, 0.1)
    assert [hit.row for hit in _top(index, rows[0], np.ones(3, bool), 3, 0.8)] == [0, 1, 2]


@pytest.mark.parametrize("lambda_s", [-0.1, 1.1, float("nan")])
def test_a_lambda_outside_its_interval_is_refused(lambda_s: float) -> None:
    with pytest.raises(ConfigurationError, match="lambda_s"):
        _top(FlatIndex(2), np.zeros(2, np.float32), np.zeros(0, bool), 1, lambda_s)
