"""The state derived from events: rollback, states in the past, exclusion, compaction, snapshots, migration."""

import sqlite3
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dualbrain.errors import ConfigurationError, UnknownNameError
from dualbrain.memory import memory as memory_module
from dualbrain.memory.learning.trust import TrustConfig
from dualbrain.memory.ledger.events import FoldedUpdates
from dualbrain.memory.ledger.ledger import Ledger, LedgerReader, PendingEvent
from dualbrain.memory.ledger.sqlite import tables
from dualbrain.memory.maintenance import compaction
from dualbrain.memory.maintenance.compaction import compact_ledger, compose_weight_updates
from dualbrain.memory.maintenance.edits import forget, quarantine, release, roll_back
from dualbrain.memory.memory import Memory
from dualbrain.memory.plasticity.hebbian_update import Plasticity
from dualbrain.memory.state import snapshot
from dualbrain.memory.state.derivation import derive_state, derive_state_at
from dualbrain.memory.state.episode_record import GUIDANCE_BY_OUTCOME
from dualbrain.memory.state.history import effective_ranges
from dualbrain.records import OutcomeClass, RetrievedContext
from tests.memory.memory_samples import CONFIG, NOW, REST_POSTURE, episode, open_ledger, open_memory

LIVELY = replace(CONFIG, plasticity=Plasticity(), trust=TrustConfig.disabled())
"""Configuration with a neighbourhood and without defences, in which every outcome changes several weights."""
WORDS = "put the red cube in the bowl"
Steps = list[tuple[OutcomeClass, float, int]]
steps = st.lists(
    st.tuples(st.sampled_from(tuple(GUIDANCE_BY_OUTCOME)), st.sampled_from((0.0, 0.002, 0.5)), st.integers(0, 3)),
    min_size=1,
    max_size=9,
)


def _recall(memory: Memory, k: int) -> RetrievedContext:
    return memory.retrieve(WORDS, "neighbour_across low", REST_POSTURE, "arm", "aaaa1111", k=k)


def _live(memory: Memory, sequence: Steps, start: int = 0) -> None:
    for i, (kind, Delta, k) in enumerate(sequence, start):
        one = episode(f"e-{i}", kind, Delta=Delta, recall=_recall(memory, k), summary=f"neighbour_across low, n{i % 3}")
        memory.store(one, REST_POSTURE, now=NOW + i)


@given(st.integers(1, 40), st.data())
def test_the_events_in_effect_are_the_path_from_parent_to_parent(head: int, data: st.DataObject) -> None:
    """Oracle: the definition, event by event."""
    marks = data.draw(st.sets(st.integers(1, 40), max_size=6))
    rollbacks = {seq: data.draw(st.integers(0, seq - 1)) for seq in sorted(marks)}
    path, at = [], head
    while at:
        path.append(at)
        at = rollbacks.get(at, at - 1)
    assert [seq for span in effective_ranges(rollbacks, head) for seq in span] == path[::-1]


@settings(max_examples=8, deadline=None)
@given(steps, steps)
def test_a_rollback_restores_the_state_exactly(tmp_path_factory: pytest.TempPathFactory, a: Steps, b: Steps) -> None:
    with open_ledger(tmp_path_factory.mktemp("l")) as ledger:
        memory = open_memory(ledger, LIVELY)
        _live(memory, a)
        then, answer, mark = memory.weights(), _recall(memory, 3), ledger.head().seq
        _live(memory, b, start=len(a))
        later, present = memory.weights(), ledger.head().seq
        roll_back(memory, mark, "a bad afternoon", now=NOW + 99)
        assert (memory.weights(), _recall(memory, 3)) == (then, answer)
        assert open_memory(ledger, LIVELY).weights() == then
        roll_back(memory, present, "it was not so bad", now=NOW + 100)
        assert memory.weights() == later
        assert ledger.verify().is_intact


@settings(max_examples=8, deadline=None)
@given(steps)
def test_the_state_at_a_time_is_the_live_state_of_that_time(
    tmp_path_factory: pytest.TempPathFactory, sequence: Steps
) -> None:
    with open_ledger(tmp_path_factory.mktemp("l")) as ledger:
        memory, live = open_memory(ledger, LIVELY), []
        for i, step in enumerate(sequence):
            _live(memory, [step], start=i)
            live.append(memory.weights())
        for i, weights in enumerate(live):
            assert derive_state_at(ledger, NOW + i + 0.5).weights() == weights
        assert derive_state_at(ledger, NOW - 1).weights() == {}


@settings(max_examples=10, deadline=None)
@given(steps, st.data())
def test_quarantine_equals_exclusion_from_the_history(
    tmp_path_factory: pytest.TempPathFactory, sequence: Steps, data: st.DataObject
) -> None:
    """Quarantine gives the same weights as a ledger with the same events but without the quarantined memories.

    A release then restores the previous weights bit for bit.
    """
    with open_ledger(tmp_path_factory.mktemp("l")) as ledger:
        memory = open_memory(ledger, LIVELY)
        _live(memory, sequence)
        before, answer = memory.weights(), _recall(memory, 3)
        bad = data.draw(st.sets(st.sampled_from(sorted(before)), min_size=1))
        expected = derive_state(ledger, excluded=bad).weights()
        replayed = _replayed_without(ledger, bad)
        quarantine(memory, sorted(bad), "an audit", now=NOW + 50)
        remaining = {name: w for name, w in memory.weights().items() if name not in bad}
        assert remaining == expected == replayed
        assert not {hit.episode_id for hit in (*_recall(memory, 9).exemplars, *_recall(memory, 9).warnings)} & bad
        release(memory, sorted(bad), "it was right", now=NOW + 51)
        assert {name: w for name, w in memory.weights().items() if name not in bad} == {
            name: w for name, w in before.items() if name not in bad
        }
        guiding = [name for name in bad if GUIDANCE_BY_OUTCOME[memory.state[name].kind] != "none"]
        if len(guiding) == len(bad):
            assert (memory.weights(), _recall(memory, 3)) == (before, answer)


def _replayed_without(ledger: Ledger, bad: set[str]) -> dict[str, float]:
    """Oracle: every stored map applied by hand, except those that `bad` caused."""
    weights: dict[str, float] = {}
    for event in ledger.events():
        payload = msgspec.json.decode(event.payload)
        if event.kind == "episode" and event.subject not in bad:
            weights[event.subject] = payload["w0"]
        elif event.kind == "weight" and payload["cause"] not in bad and payload["memory"] in weights:
            value = payload["gain"] * weights[payload["memory"]] + payload["offset"]
            weights[payload["memory"]] = min(1.0, max(0.0, value))
        elif event.kind == "neighbours" and payload["cause"] not in bad:
            for name, offset in zip(payload["memories"], payload["offsets"], strict=True):
                if name in weights:
                    weights[name] = min(1.0, max(0.0, weights[name] + offset))
    return weights


def test_a_forgotten_memory_is_not_retrieved_and_stays_in_the_chain(tmp_path: Path) -> None:
    with open_ledger(tmp_path) as ledger:
        memory = open_memory(ledger, LIVELY)
        _live(memory, [("succeeded", 0.0, 2)] * 3)
        forget(memory, ["e-1"], "a person asked", now=NOW + 9)
        assert {hit.episode_id for hit in _recall(memory, 9).exemplars} == {"e-2", "e-0"}
        with pytest.raises(ConfigurationError, match="Forgotten memories cannot be released: e-1"):
            release(memory, ["e-1"], "no", now=NOW + 10)
        assert ledger.verify().is_intact
        assert any(event.subject == "e-1" for event in ledger.events("episode"))


@pytest.mark.parametrize(
    ("names", "reason", "error"),
    [((), "why", ConfigurationError), (("e-0",), " ", ConfigurationError), (("e-9",), "why", UnknownNameError)],
)
def test_an_edit_without_memories_or_reason_is_refused(tmp_path: Path, names, reason, error) -> None:
    with open_ledger(tmp_path) as ledger:
        memory = open_memory(ledger)
        _live(memory, [("succeeded", 0.0, 0)])
        head = ledger.head()
        with pytest.raises(error):
            quarantine(memory, names, reason, now=NOW)
        with pytest.raises(ConfigurationError, match="rollback target"):
            roll_back(memory, head.seq + 1, "why", now=NOW)
        assert ledger.head() == head


def test_a_read_only_memory_retrieves_and_does_not_write(tmp_path: Path) -> None:
    with open_ledger(tmp_path) as ledger:
        memory = open_memory(ledger)
        _live(memory, [("succeeded", 0.0, 0)])
        expected = _recall(memory, 3)
        with LedgerReader(tmp_path / "ledger.db") as reader:
            reading = open_memory(reader)
            assert _recall(reading, 3) == expected
            with pytest.raises(ConfigurationError, match="opened for reading"):
                _live(reading, [("succeeded", 0.0, 0)], start=1)


# --- compaction -----------------------------------------------------------------------------------------------------


@settings(max_examples=8, deadline=None)
@given(steps, st.data())
def test_compaction_preserves_every_weight_bit_for_bit(
    tmp_path_factory: pytest.TempPathFactory, sequence: Steps, data: st.DataObject
) -> None:
    folder = tmp_path_factory.mktemp("l")
    with open_ledger(folder) as ledger:
        memory = open_memory(ledger, LIVELY)
        _live(memory, sequence)
        for name in data.draw(st.sets(st.sampled_from(sorted(memory.weights())), max_size=2)):
            data.draw(st.sampled_from((quarantine, forget)))(memory, [name], "odd", now=NOW + 50)
        weights, answer = memory.weights(), _recall(memory, 5)
        folded = compose_weight_updates(ledger, memory.state)
        assert {name: f(0.5) for name, f in folded.items()} == pytest.approx(weights, abs=1e-12)
        compact_ledger(ledger, folder / "short.db", holder="a test", now=NOW + 60)
        head = ledger.head()
    with Ledger(folder / "short.db", holder="a test", now=NOW) as short:
        again = open_memory(short, LIVELY)
        assert short.verify().is_intact
        assert (again.weights(), _recall(again, 5)) == (weights, answer)
        assert {m.id: m.status for m in again.state.memories} == {m.id: m.status for m in memory.state.memories}
        first = next(iter(short.events()))
        assert f'"hash":"{head.hash}"'.encode() in first.payload
        _live(again, [("succeeded", 0.0, 2)], start=90)
    with pytest.raises(ConfigurationError, match="exists already"), LedgerReader(folder / "ledger.db") as reader:
        compact_ledger(reader, folder / "short.db", holder="a test", now=NOW)


def _compacted(folder: Path, name: str, source: Ledger) -> Ledger:
    compact_ledger(source, folder / name, holder="a test", now=NOW + 60)
    return open_ledger(folder, name)


def _without_own_outcomes(**fields: object) -> FoldedUpdates:
    """The folded event of an earlier version."""
    return FoldedUpdates(**{**fields, "has_own_outcome": None})


@pytest.mark.parametrize("version", ["present", "earlier"])
def test_a_release_after_a_compaction_does_not_count_an_outcome_twice(
    tmp_path: Path, version: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    if version == "earlier":
        monkeypatch.setattr(compaction, "FoldedUpdates", _without_own_outcomes)
    with open_ledger(tmp_path) as ledger:
        _live(open_memory(ledger, LIVELY), SEQUENCE)
        with _compacted(tmp_path, "short.db", ledger) as short:
            memory = open_memory(short, LIVELY)
            before = memory.weights()
            quarantine(memory, ["e-2", "e-1"], "odd", now=NOW + 61)
            release(memory, ["e-2", "e-1"], "right", now=NOW + 62)
            assert memory.weights() == before


def test_an_outcome_that_a_compaction_left_out_counts_once_after_a_release(tmp_path: Path) -> None:
    with open_ledger(tmp_path) as ledger:
        memory = open_memory(ledger, LIVELY)
        _live(memory, SEQUENCE)
        with_outcome = memory.weights()["e-2"]
        quarantine(memory, ["e-2"], "odd", now=NOW + 50)
        assert memory.weights()["e-2"] != with_outcome
        with _compacted(tmp_path, "short.db", ledger) as short:
            memory = open_memory(short, LIVELY)
            release(memory, ["e-2"], "right", now=NOW + 61)
            released = memory.weights()
            assert next(event.subject for event in short.events("weight")) == "e-2"
            quarantine(memory, ["e-2"], "odd", now=NOW + 62)
            release(memory, ["e-2", "e-2"], "right", now=NOW + 63)
            assert memory.weights() == released


def test_an_outcome_that_the_first_of_two_compactions_folded_is_not_counted_again(tmp_path: Path) -> None:
    with open_ledger(tmp_path) as ledger:
        _live(open_memory(ledger, LIVELY), SEQUENCE)
        with _compacted(tmp_path, "short.db", ledger) as short:
            memory = open_memory(short, LIVELY)
            before = memory.weights()
            quarantine(memory, ["e-2"], "odd", now=NOW + 61)
            with _compacted(tmp_path, "shorter.db", short) as shorter:
                memory = open_memory(shorter, LIVELY)
                release(memory, ["e-2"], "right", now=NOW + 62)
                assert memory.weights() == before


# --- releases -------------------------------------------------------------------------------------------------------


def test_a_release_after_a_rollback_of_the_release_updates_the_weights_again(tmp_path: Path) -> None:
    with open_ledger(tmp_path) as ledger:
        memory = open_memory(ledger)
        _live(memory, [("succeeded", 0.0, 0)])
        memory.store(episode("b", second_opinion="none", recall=_recall(memory, 1)), REST_POSTURE, now=NOW + 1)
        before, mark = memory.weights(), ledger.head().seq
        release(memory, ["b"], "seen", now=NOW + 2)
        released = memory.weights()
        roll_back(memory, mark, "a mistake", now=NOW + 3)
        assert memory.weights() == before != released
        release(memory, ["b"], "seen after all", now=NOW + 4)
        assert memory.weights() == released == derive_state(ledger).weights()


def test_a_release_and_its_weight_updates_are_one_transaction(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    config = replace(LIVELY, trust=TrustConfig())
    with open_ledger(tmp_path) as ledger:
        memory = open_memory(ledger, config)
        for name in ("a", "b"):
            memory.store(episode(name, second_opinion="disagrees"), REST_POSTURE, now=NOW)
        append, transactions = Ledger.append, list[list[str]]()

        def counted(self: Ledger, entries: list[PendingEvent], **settings: object) -> object:
            transactions.append([entry.kind for entry in entries])
            return append(self, entries, **settings)

        monkeypatch.setattr(Ledger, "append", counted)
        release(memory, ["a", "b"], "right", now=NOW + 1)
        assert transactions == [["release", "weight", "neighbours", "weight", "neighbours"]]
        assert {memo.status for memo in memory.state.memories} == {"active"}
        assert memory.weights() == open_memory(ledger, config).weights()
        assert {event.subject for event in ledger.events("neighbours")} == {"a", "b"}


def test_a_release_of_an_active_memory_changes_no_weight(tmp_path: Path) -> None:
    """Its outcome was stored by a memory without plasticity, which counts no outcome."""
    with open_ledger(tmp_path) as ledger:
        _live(open_memory(ledger, replace(LIVELY, plasticity=None)), [("succeeded", 0.0, 0)])
        memory = open_memory(ledger, LIVELY)
        release(memory, ["e-0"], "right", now=NOW + 1)
        assert memory.weights() == {"e-0": 0.5}


# --- snapshots ------------------------------------------------------------------------------------------------------


def _snapshot_of(folder: Path, sequence: Steps, monkeypatch: pytest.MonkeyPatch) -> dict[str, float]:
    with open_ledger(folder) as ledger:
        memory = open_memory(ledger, LIVELY)
        _live(memory, sequence)
        memory.write_snapshot(ledger, now=NOW + 70)
        _live(memory, [("failed", 0.5, 2), ("succeeded", 0.0, 1)], start=70)
        monkeypatch.setattr(memory_module, "derive_state", _never)
        return memory.weights()


def _never(*_: object) -> None:
    raise AssertionError("every event was read")


SEQUENCE: Steps = [("succeeded", 0.0, 2), ("failed", 0.1, 1), ("succeeded", 0.002, 3), ("rejected", 0.0, 2)]


def test_a_start_from_a_snapshot_equals_one_from_the_first_event(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    weights = _snapshot_of(tmp_path, SEQUENCE, monkeypatch)
    with open_ledger(tmp_path) as ledger:
        quick = open_memory(ledger, LIVELY)
        monkeypatch.undo()
        slow = derive_state(ledger)
        assert quick.weights() == weights == slow.weights()
        assert quick.state.influence == slow.influence
        assert [m.status for m in quick.state.memories] == [m.status for m in slow.memories]
        monkeypatch.setattr(snapshot, "read_snapshot", lambda _: None)
        assert _recall(quick, 5) == _recall(open_memory(ledger, LIVELY), 5)


@pytest.mark.parametrize("where", [0, 9, 40, -1, -700])
def test_a_damaged_snapshot_is_ignored(tmp_path: Path, where: int, monkeypatch: pytest.MonkeyPatch) -> None:
    weights = _snapshot_of(tmp_path, SEQUENCE, monkeypatch)
    monkeypatch.undo()
    (path,) = tmp_path.glob("*.snapshot-*")
    raw = bytearray(path.read_bytes())
    raw[where] ^= 1
    path.write_bytes(raw)
    with open_ledger(tmp_path) as ledger:
        assert snapshot.read_snapshot(ledger) is None
        assert open_memory(ledger, LIVELY).weights() == weights


@pytest.mark.parametrize("length", [0, 5, 300, -1])
def test_a_torn_snapshot_is_ignored(tmp_path: Path, length: int, monkeypatch: pytest.MonkeyPatch) -> None:
    weights = _snapshot_of(tmp_path, SEQUENCE, monkeypatch)
    monkeypatch.undo()
    (path,) = tmp_path.glob("*.snapshot-*")
    path.write_bytes(path.read_bytes()[:length])
    with open_ledger(tmp_path) as ledger:
        assert open_memory(ledger, LIVELY).weights() == weights


def test_a_long_start_writes_a_snapshot(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory_module, "SNAPSHOT_MIN_EVENTS", 3)
    with open_ledger(tmp_path) as ledger:
        _live(open_memory(ledger, LIVELY), SEQUENCE)
    with open_ledger(tmp_path) as ledger:
        weights = open_memory(ledger, LIVELY).weights()
        assert snapshot.read_snapshot(ledger) is not None
        assert ledger.verify().is_intact
    monkeypatch.setattr(memory_module, "derive_state", _never)
    with open_ledger(tmp_path) as ledger:
        assert open_memory(ledger, LIVELY).weights() == weights


def test_an_edit_after_a_snapshot_counts_at_the_next_start(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    _snapshot_of(tmp_path, SEQUENCE, monkeypatch)
    monkeypatch.undo()
    with open_ledger(tmp_path) as ledger:
        memory = open_memory(ledger, LIVELY)
        quarantine(memory, ["e-0"], "odd", now=NOW + 80)
        weights = memory.weights()
    with open_ledger(tmp_path) as ledger:
        assert open_memory(ledger, LIVELY).weights() == weights


# --- migration ------------------------------------------------------------------------------------------------------


def test_an_old_ledger_is_migrated_and_keeps_its_chain(tmp_path: Path) -> None:
    path = tmp_path / "ledger.db"
    with sqlite3.connect(path) as database:
        database.executescript(tables._SCHEMA_V1)
    database.close()
    with LedgerReader(path) as reader:
        assert (reader.schema, reader.verify().is_intact) == (1, True)
        with pytest.raises(ConfigurationError, match="schema_version: got 1, allowed: 2"):
            list(reader.vectors())
    with open_ledger(tmp_path) as ledger:
        assert ledger.schema == tables.SCHEMA_VERSION
        (event,) = ledger.events()
        assert (event.kind, event.payload) == ("migrated", b'{"from":1,"to":2}')
        ledger.append([PendingEvent(kind="note", subject="", payload=1)], now=NOW)
        assert ledger.verify().is_intact
        columns = {row[1] for row in ledger._store.database.execute("PRAGMA table_info(vector)")}
    with open_ledger(tmp_path / "new") as fresh:
        assert columns == {row[1] for row in fresh._store.database.execute("PRAGMA table_info(vector)")}
        assert fresh.head().seq == 0


def test_rows_of_a_snapshot_are_those_of_the_projection(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    _snapshot_of(tmp_path, SEQUENCE, monkeypatch)
    monkeypatch.undo()
    with open_ledger(tmp_path) as ledger:
        read = snapshot.read_snapshot(ledger)
        assert read is not None
        stored = [np.frombuffer(vector.data, "<f4") for _, vector in ledger.vectors()]
        assert np.array_equal(read.rows, stored[: len(read.rows)])
