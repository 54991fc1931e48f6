"""Queries: filters, diversity, settings of a query, missing blocks, and all parts of a score."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dualbrain.errors import ConfigurationError
from dualbrain.memory.embedding.image_encoder import IMAGE_ENCODER_ID
from dualbrain.memory.embedding.image_features import ImageFeatures
from dualbrain.memory.embedding.joint_embedding import Alpha
from dualbrain.memory.index.filters import Filter
from dualbrain.memory.memory import Memory
from dualbrain.memory.retrieval.mmr import select_diverse
from dualbrain.memory.retrieval.search import FlatIndex, Query
from tests.memory.memory_samples import NOW, REST_POSTURE, episode, grasp_contract, open_ledger, open_memory, unit_rows

WORDS, SCENE = "put the red cube in the bowl", "neighbour_across low"


def _ids(memory: Memory, **settings: Any) -> list[str]:
    return [
        h.episode_id for h in memory.retrieve(WORDS, SCENE, REST_POSTURE, "arm", "aaaa1111", k=9, **settings).exemplars
    ]


@pytest.mark.parametrize(
    ("where", "expected"),
    [
        (Filter(), {"a", "b", "c"}),
        (Filter(skills=("push",)), {"b"}),
        (Filter(skills=("grasp", "push")), set()),
        (Filter(after=NOW + 1.5), {"c"}),
        (Filter(before=NOW + 1.5), {"a", "b"}),
        (Filter(sources=("other planner",)), {"c"}),
        (Filter(statuses=("candidate",)), {"d"}),
        (Filter(statuses=("active", "candidate")), {"a", "b", "c", "d"}),
        (Filter(outcomes=("declined",)), set()),
    ],
)
def test_filters_restrict_the_hits(tmp_path: Path, where: Filter, expected: set[str]) -> None:
    push = {**grasp_contract(), "action_sequence": [{"skill": "push", "params": {"object": "mug"}}]}
    with open_ledger(tmp_path) as ledger:
        memory = open_memory(ledger)
        memory.store(episode("a"), REST_POSTURE, now=NOW)
        memory.store(episode("b", plan=push), REST_POSTURE, now=NOW + 1)
        memory.store(episode("c", proposer="other planner"), REST_POSTURE, now=NOW + 2)
        memory.store(episode("d", plan=grasp_contract("mug"), second_opinion="none"), REST_POSTURE, now=NOW + 3)
        assert set(_ids(memory, where=where)) == expected


def test_lambda_and_alpha_are_settings_of_the_query(tmp_path: Path) -> None:
    with open_ledger(tmp_path) as ledger:
        memory = open_memory(ledger)
        memory.store(episode("words", summary="person: crossing, overhead"), REST_POSTURE, now=NOW)
        memory.store(
            episode("scene", instruction="tidy up the table", plan=grasp_contract("cup")), REST_POSTURE, now=NOW
        )
        for i in range(6):
            shown = memory.retrieve("tidy up the table", SCENE, REST_POSTURE, "arm", "aaaa1111", k=1)
            memory.store(
                episode(f"f-{i}", "failed", plan=grasp_contract("cup"), recall=without_warnings(shown)),
                REST_POSTURE,
                now=NOW,
            )
        assert memory.weights()["scene"] < 0.1
        assert _ids(memory, alpha=Alpha(instruction=1.0, summary=0.0, symbols=0.0, image=0.0, state=0.0))[0] == "words"
        assert (
            _ids(memory, alpha=Alpha(instruction=0.0, summary=1.0, symbols=0.0, image=0.0, state=0.0), lambda_s=1.0)[0]
            == "scene"
        )
        assert (
            _ids(memory, alpha=Alpha(instruction=0.0, summary=1.0, symbols=0.0, image=0.0, state=0.0), lambda_s=0.0)[0]
            == "words"
        )


def without_warnings(recall: Any) -> Any:
    """The exemplars only."""
    return type(recall)(recall.exemplars)


def test_every_part_of_a_score_is_reported(tmp_path: Path) -> None:
    image = ImageFeatures.from_vector(IMAGE_ENCODER_ID, np.arange(1.0, 129.0).astype(np.float32))
    with open_ledger(tmp_path) as ledger:
        memory = open_memory(ledger)
        memory.store(episode("seen"), REST_POSTURE, now=NOW, image=image)
        memory.store(episode("unseen"), REST_POSTURE, now=NOW)
        seen, unseen = (
            memory.retrieve(WORDS, SCENE, REST_POSTURE, "arm", "aaaa1111", k=2, image=queried).exemplars
            for queried in (image, None)
        )
        for hit in (*seen, *unseen):
            alpha = memory.config.embedding.alpha
            shares = {name: getattr(alpha, name) for name in hit.parts}
            cosine = sum(shares[name] * part for name, part in hit.parts.items()) / sum(shares.values())
            assert hit.similarity == pytest.approx((1.0 + cosine) / 2.0, abs=1e-5)
            assert hit.score == pytest.approx(0.8 * hit.similarity + 0.2 * hit.weight, abs=1e-9)
        assert {hit.episode_id: "image" in hit.parts for hit in seen} == {"seen": True, "unseen": False}
        assert not any("image" in hit.parts for hit in unseen)
        assert all(hit.similarity == pytest.approx(1.0, abs=1e-5) for hit in (*seen, *unseen))


@given(st.integers(0, 10_000), st.sampled_from((0.0, 0.3, 0.7, 1.0)), st.integers(1, 6))
def test_diversity_is_the_greedy_choice_of_its_definition(seed: int, d: float, k: int) -> None:
    """Oracle: the formula of the docstring, pair by pair in float64."""
    rng = np.random.default_rng(seed)
    rows, weights = unit_rows(rng, 40, 6), rng.random(40)
    index = FlatIndex(6)
    for row, w in zip(rows, weights, strict=True):
        index.add(row, float(w))
    compared = index.compare(Query.single_block(unit_rows(rng, 1, 6)[0]))
    pool = index.top_k(compared, np.ones(40, bool), 8 * k, 0.8)
    expected = [pool[0]]
    while len(expected) < k:

        def value(hit: Any, chosen: tuple[Any, ...] = tuple(expected)) -> float:
            similarity = max((1.0 + float(rows[hit.row].astype(float) @ rows[one.row])) / 2.0 for one in chosen)
            return (1.0 - d) * hit.score - d * similarity

        expected.append(max((hit for hit in pool if hit not in expected), key=value))
    got = select_diverse(index, compared, np.ones(40, bool), k, 0.8, d)
    assert [hit.row for hit in got] == [hit.row for hit in expected]
    assert index.top_k(compared, np.ones(40, bool), k, 0.8) == select_diverse(
        index, compared, np.ones(40, bool), k, 0.8, 0.0
    )


def test_diverse_retrieval_does_not_repeat_near_duplicates(tmp_path: Path) -> None:
    with open_ledger(tmp_path) as ledger:
        memory = open_memory(ledger)
        for i in range(4):
            memory.store(episode(f"same-{i}"), REST_POSTURE, now=NOW)
        memory.store(episode("other", summary="neighbour_along tall"), REST_POSTURE, now=NOW)
        assert "other" not in _ids(memory)[:2]
        assert _ids(memory, diversity=0.5)[1] == "other"
        with pytest.raises(ConfigurationError, match="diversity"):
            _ids(memory, diversity=1.5)
