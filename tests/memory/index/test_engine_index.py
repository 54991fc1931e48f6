"""An index with a vector engine has the results of the scan, also if the engine lacks rows or does not answer."""

import dataclasses

import numpy as np
import pytest

from dualbrain.errors import ConfigurationError
from dualbrain.memory.embedding.joint_embedding import Alpha
from dualbrain.memory.index import engine_index
from dualbrain.memory.index.engine_index import EngineIndex
from dualbrain.memory.index.engines.engine import EngineRefusalError
from dualbrain.memory.index.filters import Filter
from dualbrain.memory.index.index import Index, RankingOptions, RetrievalScope
from dualbrain.memory.ledger.hash_chain import Head
from dualbrain.memory.plasticity.hebbian_update import BANDWIDTH, Plasticity
from dualbrain.memory.state.snapshot import MemorySnapshot
from tests.memory.index.engines_under_test import NumpyEngine
from tests.memory.memory_samples import CONFIG, NOW, REST_POSTURE, episode, grasp_contract, open_ledger, open_memory

VERBS, OBJECTS = ("put", "lift", "push", "hand me"), ("red cube", "mug", "bowl", "screw", "plate", "blue box")
SCENES = ("neighbour_across low", "person: crossing, overhead", "cube: object, box above", "free table")
KINDS = ("succeeded", "succeeded", "failed", "rejected")
SCOPE = RetrievalScope(robot="arm", registry="aaaa1111", bandwidth=BANDWIDTH)
BOTH = [
    (Filter(robot="arm", registry="aaaa1111", guidance="follow"), RankingOptions(5, 0.8)),
    (Filter(robot="arm", registry="aaaa1111", guidance="avoid"), RankingOptions(2, 0.8)),
]


@pytest.fixture(scope="module")
def memory(tmp_path_factory):
    """A memory of 150 episodes, of two robots, with weights of all sizes, candidates and missing blocks."""
    rng = np.random.default_rng(3)
    config = dataclasses.replace(CONFIG, plasticity=Plasticity())
    with open_ledger(tmp_path_factory.mktemp("ledger")) as ledger:
        memory = open_memory(ledger, config)
        for number in range(150):
            verb, name, scene = (rng.choice(words) for words in (VERBS, OBJECTS, SCENES))
            one = episode(
                f"e-{number}",
                kind=str(rng.choice(KINDS)),
                instruction=f"{verb} the {name}",
                summary=str(scene),
                plan=grasp_contract(str(rng.choice(OBJECTS[:3]))),
                robot="other" if number % 10 == 0 else "arm",
                registry="bbbb2222" if number % 7 == 0 else "aaaa1111",
                second_opinion="none" if number % 9 == 0 else "agrees",
            )
            posture = (
                None if number % 10 == 0 else dataclasses.replace(REST_POSTURE, q=tuple(rng.normal(0, 0.5, 2).tolist()))
            )
            memory.store(one, posture, now=NOW + number)
        yield memory


def with_engine(memory, engine):
    """The index of `memory` with `engine`."""
    index = EngineIndex(memory.embedding, engine, memory.ledger)
    vectors = dict(memory.ledger.vectors())
    for memo in memory.state.memories:
        index.add(memo, vectors.get(memo.seq))
    return index


def queries(memory, number=6):
    rng = np.random.default_rng(5)
    for k in range(number):
        words = f"{rng.choice(VERBS)} the {rng.choice(OBJECTS)}"
        alpha = Alpha() if k % 3 else Alpha(instruction=0.2, summary=0.2, symbols=0.2, image=0.2, state=0.2)
        posture = REST_POSTURE if k % 2 else None
        embedded = memory.embedding.embed(words, str(rng.choice(SCENES)), posture, "arm")
        yield memory.index.query(embedded, alpha)


def assert_same_hits(found, expected):
    assert [len(hits) for hits in found] == [len(hits) for hits in expected]
    for hits, others in zip(found, expected, strict=True):
        assert [hit.score for hit in hits] == pytest.approx([hit.score for hit in others], abs=1e-5)
        assert [hit.row for hit in hits] == [hit.row for hit in others]


@pytest.mark.parametrize("first_count", [1, 8, 64])
@pytest.mark.parametrize("lambda_s", [0.0, 0.3, 0.8, 1.0])
@pytest.mark.parametrize("diversity", [0.0, 0.5])
def test_the_hits_are_those_of_the_scan(memory, monkeypatch, first_count, lambda_s, diversity):
    monkeypatch.setattr(engine_index, "FIRST_COUNT", first_count)
    index = with_engine(memory, NumpyEngine())
    searches = [
        (where, dataclasses.replace(ranking, lambda_s=lambda_s, diversity=diversity)) for where, ranking in BOTH
    ]
    for query in queries(memory):
        assert_same_hits(index.retrieve(query, SCOPE, searches), memory.index.retrieve(query, SCOPE, searches))


@pytest.mark.parametrize(
    "where",
    [
        Filter(statuses=("active", "candidate")),
        Filter(robot="arm", skills=("grasp",), after=NOW + 60),
        Filter(robot="other"),
        Filter(robot="arm", statuses=("forgotten",)),
    ],
    ids=range(4),
)
def test_filters_restrict_the_hits_as_in_the_scan(memory, monkeypatch, where):
    monkeypatch.setattr(engine_index, "FIRST_COUNT", 2)
    index = with_engine(memory, NumpyEngine())
    search = [(where, RankingOptions(6, 0.8))]
    for query in queries(memory, 4):
        assert_same_hits(index.retrieve(query, SCOPE, search), memory.index.retrieve(query, SCOPE, search))


@pytest.mark.parametrize("min_cosine", [-1.0, 0.3, 0.8, 0.999])
@pytest.mark.parametrize("max_count", [1, 7, 500])
def test_similar_rows_are_those_of_the_scan(memory, monkeypatch, min_cosine, max_count):
    monkeypatch.setattr(engine_index, "FIRST_COUNT", 2)
    index = with_engine(memory, NumpyEngine())
    where = Filter(robot="arm", registry="aaaa1111", statuses=("active", "candidate"))
    for query in queries(memory, 5):
        found = index.find_similar(query, where, min_cosine, max_count)
        expected = memory.index.find_similar(query, where, min_cosine, max_count)
        assert [row for row, _ in found] == [row for row, _ in expected]
        assert [cosine for _, cosine in found] == pytest.approx([cosine for _, cosine in expected], abs=1e-6)


def test_few_rows_are_requested_where_similarity_decides(memory, monkeypatch):
    monkeypatch.setattr(engine_index, "FIRST_COUNT", 8)
    engine = NumpyEngine()
    index = with_engine(memory, engine)
    index.update_engine()
    index.retrieve(next(queries(memory)), SCOPE, [(BOTH[0][0], RankingOptions(1, 1.0))])
    assert max(engine.searched) < len(memory) / 3


def test_without_an_engine_the_vectors_of_the_ledger_are_searched(memory):
    engine = NumpyEngine()
    index = with_engine(memory, engine)
    for answers in (False, True, False):
        engine.answers = answers
        for query in queries(memory, 3):
            assert_same_hits(index.retrieve(query, SCOPE, BOTH), memory.index.retrieve(query, SCOPE, BOTH))
    assert len(engine.vectors) == len(memory)


def test_a_row_that_the_engine_lacks_is_read_from_the_ledger(memory, monkeypatch):
    """As with a role that may only read the table of the engine."""
    monkeypatch.setattr(engine_index, "FIRST_COUNT", 4)
    search = [(BOTH[0][0], RankingOptions(1, 1.0))]
    for query in queries(memory):
        best = memory.index.retrieve(query, SCOPE, search)
        engine = NumpyEngine()
        with_engine(memory, engine).update_engine()
        lacking = memory.state.memories[best[0][0].row].seq
        engine.vectors = {key: vector for key, vector in engine.vectors.items() if key[0] != lacking}
        index = with_engine(memory, engine)
        monkeypatch.setattr(engine, "add", engine.refuse)
        assert_same_hits(index.retrieve(query, SCOPE, search), best)


def test_a_wrong_vector_in_the_engine_changes_no_score(memory):
    engine = NumpyEngine()
    index = with_engine(memory, engine)
    index.update_engine()
    for key in engine.vectors:
        engine.vectors[key] = np.roll(engine.vectors[key], 7)
    for query in queries(memory, 3):
        exact = memory.index.retrieve(query, SCOPE, [(BOTH[0][0], RankingOptions(200, 0.8))])[0]
        scores = {hit.row: hit.score for hit in exact}
        for hit in index.retrieve(query, SCOPE, BOTH)[0]:
            assert hit.score == pytest.approx(scores[hit.row], abs=1e-5)


def test_a_second_start_adds_nothing_and_reads_no_vector(memory, monkeypatch):
    engine = NumpyEngine()
    with_engine(memory, engine).update_engine()
    state, masks = memory.state, memory.index.masks
    versions = memory.index.versions(state)
    empty = np.empty((len(memory), 0), np.float32)
    snapshot = MemorySnapshot(head=Head(1, ""), versions=versions, state=state, rows=empty, masks=masks)
    again = EngineIndex(memory.embedding, engine, memory.ledger)
    assert again.is_compatible(snapshot)
    assert not Index(memory.embedding).is_compatible(snapshot)
    again.load(snapshot)
    monkeypatch.setattr(engine, "add", lambda *_: pytest.fail("a row was added again"))
    for query in queries(memory, 3):
        assert_same_hits(again.retrieve(query, SCOPE, BOTH), memory.index.retrieve(query, SCOPE, BOTH))


def test_all_rows_and_one_row_are_read_from_the_ledger(memory):
    index = with_engine(memory, NumpyEngine())
    assert np.array_equal(index.rows, memory.index.rows)
    assert np.array_equal(index.embedding_of(5).vector, memory.index.rows[5])
    assert index.flat_index.rows.size == 0


def test_a_vector_that_the_ledger_lacks_is_an_error_and_reaches_no_engine(tmp_path):
    with open_ledger(tmp_path) as ledger:
        memory = open_memory(ledger)
        for name in ("a", "b"):
            memory.store(episode(name), REST_POSTURE, now=NOW)
        engine = NumpyEngine()
        index = with_engine(memory, engine)
        ledger._store.database.execute("DELETE FROM vector WHERE seq = ?", (memory.state["b"].seq,))
        with pytest.raises(ConfigurationError, match="embedding of event"):
            index.update_engine()
        assert not engine.vectors


def test_an_engine_that_refuses_is_asked_once_and_named(memory, monkeypatch):
    def refuse(*_):
        calls.append(1)
        raise EngineRefusalError("permission denied")

    calls = []
    engine = NumpyEngine()
    index = with_engine(memory, engine)
    monkeypatch.setattr(engine, "add", refuse)
    for query in queries(memory, 3):
        assert_same_hits(index.retrieve(query, SCOPE, BOTH), memory.index.retrieve(query, SCOPE, BOTH))
    assert len(calls) == 1
    assert [notice for notice in memory.ledger.notices if "permission denied" in notice]


def test_nothing_is_found_for_no_places_and_wrong_settings_are_refused(memory):
    index = with_engine(memory, NumpyEngine())
    query = next(queries(memory))
    assert index.find_similar(query, Filter(), -1.0, 0) == memory.index.find_similar(query, Filter(), -1.0, 0) == []
    assert index.retrieve(query, SCOPE, [(Filter(), RankingOptions(0, 0.8))]) == [()]
    for settings in ({"lambda_s": 1.5}, {"lambda_s": 0.5, "diversity": 2.0}):
        with pytest.raises(ConfigurationError):
            RankingOptions(0, **settings)
