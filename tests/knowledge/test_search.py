"""Search: the fused score, filters, recall on written questions, and scores of unrelated questions."""

import os
from collections.abc import Iterator
from itertools import product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dualbrain.core.weights import default_cache_folder
from dualbrain.grounding.document_retrieval import Budget
from dualbrain.knowledge.builtin_documents import add_builtin_documents
from dualbrain.knowledge.library import Library, fuse_scores
from dualbrain.memory.embedding.hashing_encoder import HashingEncoder
from dualbrain.memory.embedding.text_encoder import MiniLmEncoder
from tests.knowledge.search_questions import OFF_TOPIC_QUESTIONS, QUESTIONS, section_name

scores = st.dictionaries(st.integers(0, 9), st.floats(0.01, 30), max_size=8)
cosines = st.dictionaries(st.integers(0, 9), st.floats(-1, 1), max_size=8)


@settings(deadline=None)
@given(scores, cosines, st.floats(0, 1))
def test_the_fused_score_is_bounded_and_equals_each_part_at_the_extreme_weights(
    words: dict[int, float], meaning: dict[int, float], weight: float
) -> None:
    fused = fuse_scores(words, meaning, weight)
    assert fused.keys() == {*words, *meaning}
    assert all(0.0 <= score <= 1.0 + 1e-12 for score in fused.values())
    only = fuse_scores(words, meaning, 0.0)
    best = max(words.values(), default=1.0)
    for a, b in product(words.items(), repeat=2):
        assert (only[a[0]] > only[b[0]]) == (a[1] / best > b[1] / best)
    assert all(fuse_scores(words, meaning, 1.0)[item] == max(0.0, cosine) for item, cosine in meaning.items())


def test_search_by_meaning_is_an_exact_scan(builtin_library: Library) -> None:
    encoder = HashingEncoder(64)
    query = "how hard may the fingers squeeze a cup"
    texts = [(str(c), t) for d in builtin_library.documents() for c, t in builtin_library.chunks_of(d.name)]
    hits = builtin_library.search(query, len(texts), mode="meaning")
    assert len(hits) == len(texts)
    vector = encoder.encode([query])[0]
    for hit in hits:
        descriptions = [line.split('"')[1] for line in hit.text.splitlines() if line.startswith(("use", "about"))]
        words = descriptions if hit.text.startswith("[[") else [hit.text]
        encoded = ". ".join((*(hit.path[-2:] or (hit.title,)), *words))
        assert hit.likeness == pytest.approx(float(encoder.encode([encoded])[0] @ vector), abs=1e-6)
    assert np.all(np.diff([hit.score for hit in hits]) <= 1e-12)


def test_words_are_stemmed_optional_and_weighted_by_rarity(builtin_library: Library) -> None:
    best = builtin_library.search("singularities of the wrists", 3, mode="words")
    assert section_name(best[0].citation.document, best[0].path) == "ur5e-notes/Singular postures"
    assert builtin_library.search("xyzzy", mode="words") == ()
    assert builtin_library.search("what is the", mode="words") == ()


def test_kinds_and_robots_are_filters(builtin_library: Library) -> None:
    assert {hit.kind for hit in builtin_library.search("speed", 50, kinds=("rule",))} == {"rule"}
    documents = {
        hit.citation.document for hit in builtin_library.search("payload and reach of the arm", 99, robot="panda")
    }
    assert "ur5e-notes" not in documents
    assert {"panda-hand", "site-rules"} <= documents


def test_every_question_names_existing_sections(builtin_library: Library) -> None:
    existing = {
        section_name(hit.citation.document, hit.path) for hit in builtin_library.search("x", 999, mode="meaning")
    }
    assert len(QUESTIONS) >= 40
    assert {answer for _, answers in QUESTIONS for answer in answers} <= existing


@pytest.fixture(scope="module")
def encoded_library(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Library]:
    """A library with the built-in documents and the sentence encoder MiniLM."""
    cache = default_cache_folder(os.environ)
    encoder = MiniLmEncoder.from_cache(cache)
    with Library(tmp_path_factory.mktemp("encoded") / "k.sqlite", encoder, write=True) as opened:
        add_builtin_documents(opened, now=1.0)
        yield opened


@pytest.mark.llm
def test_nine_of_ten_questions_find_their_section_among_three_hits(encoded_library: Library) -> None:
    found = {}
    for by in ("both", "words", "meaning"):
        found[by] = sum(
            any(
                section_name(hit.citation.document, hit.path) in answers
                for hit in encoded_library.search(question, 3, mode=by)
            )
            for question, answers in QUESTIONS
        )
    assert found["both"] >= 0.88 * len(QUESTIONS)
    assert found["both"] >= max(found["words"], found["meaning"])


@pytest.mark.llm
def test_unrelated_questions_stay_below_the_relevance_threshold(encoded_library: Library) -> None:
    threshold = Budget().min_relevance
    for question in OFF_TOPIC_QUESTIONS:
        assert all((hit.likeness or 0.0) < threshold for hit in encoded_library.search(question, 5))
