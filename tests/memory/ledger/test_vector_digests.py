"""The hash chain covers the vectors: each change of a vector is found at the start and by a verification."""

import sqlite3
from pathlib import Path

import numpy as np
import pytest

from dualbrain.memory.embedding.hashing_encoder import HashingEncoder
from dualbrain.memory.embedding.joint_embedding import JointEmbedding
from dualbrain.memory.index.index import rebuild_vectors
from dualbrain.memory.ledger import ledger as ledger_module
from dualbrain.memory.ledger.hash_chain import CorruptLedgerError
from dualbrain.memory.ledger.ledger import LedgerReader
from dualbrain.memory.maintenance.compaction import compact_in_place
from dualbrain.memory.maintenance.verification import verify
from tests.memory.memory_samples import CONFIG, NOW, REST_POSTURE, episode, open_ledger, open_memory

CHANGES = {
    "bit": "UPDATE vector SET data = CAST(x'01' AS BLOB) || substr(data, 2) WHERE seq = {seq}",
    "zeros": "UPDATE vector SET data = zeroblob(length(data)) WHERE seq = {seq}",
    "shorter": "UPDATE vector SET data = substr(data, 1, length(data) - 4) WHERE seq = {seq}",
    "text": "UPDATE vector SET data = 'text' WHERE seq = {seq}",
    "mask": "UPDATE vector SET mask = mask + 1 WHERE seq = {seq}",
    "mask text": "UPDATE vector SET mask = 'x' WHERE seq = {seq}",
    "version": "UPDATE vector SET version = version || 'x' WHERE seq = {seq}",
    "removed": "DELETE FROM vector WHERE seq = {seq}",
    "copied": "UPDATE vector SET data = (SELECT data FROM vector ORDER BY seq DESC LIMIT 1) WHERE seq = {seq}",
}


def fill(folder: Path) -> list[int]:
    """Three memories; returns the numbers of their events."""
    with open_ledger(folder) as ledger:
        memory = open_memory(ledger)
        for name, text in (("a", "put the red cube in the bowl"), ("b", "push the mug"), ("c", "open the drawer")):
            memory.store(episode(name, instruction=text), REST_POSTURE, now=NOW)
        return [memo.seq for memo in memory.state.memories]


def change(folder: Path, *statements: str) -> None:
    database = sqlite3.connect(folder / "ledger.db")
    for statement in statements:
        database.execute(statement)
    database.commit()
    database.close()


@pytest.mark.parametrize("name", CHANGES)
@pytest.mark.parametrize("which", [0, 1])
def test_a_changed_vector_is_found_at_the_start_and_by_verify(tmp_path: Path, name: str, which: int) -> None:
    seq = fill(tmp_path)[which]
    change(tmp_path, CHANGES[name].format(seq=seq))
    with (
        open_ledger(tmp_path) as ledger,
        pytest.raises(CorruptLedgerError, match=rf"event {seq}.*dualbrain memory rebuild"),
    ):
        open_memory(ledger)
    with LedgerReader(tmp_path / "ledger.db") as reader:
        found = verify(reader)
        assert (found.is_intact, found.chain.is_intact, list(found.vectors.faults)) == (False, True, [seq])
        with pytest.raises(CorruptLedgerError, match=f"event {seq}"):
            open_memory(reader)


def test_swapped_vectors_are_found(tmp_path: Path) -> None:
    first, second, _ = fill(tmp_path)
    change(
        tmp_path,
        f"UPDATE vector SET seq = 999 WHERE seq = {first}",
        f"UPDATE vector SET seq = {first} WHERE seq = {second}",
        f"UPDATE vector SET seq = {second} WHERE seq = 999",
    )
    with LedgerReader(tmp_path / "ledger.db") as reader:
        assert list(verify(reader).vectors.faults) == [first, second]


@pytest.mark.parametrize("seed", range(4))
def test_any_flipped_bit_of_a_vector_is_found(tmp_path: Path, seed: int) -> None:
    rng, seqs = np.random.default_rng(seed), fill(tmp_path)
    seq = int(rng.choice(seqs))
    database = sqlite3.connect(tmp_path / "ledger.db")
    data = bytearray(database.execute("SELECT data FROM vector WHERE seq = ?", (seq,)).fetchone()[0])
    data[int(rng.integers(len(data)))] ^= 1 << int(rng.integers(8))
    database.execute("UPDATE vector SET data = ? WHERE seq = ?", (bytes(data), seq))
    database.commit()
    database.close()
    with LedgerReader(tmp_path / "ledger.db") as reader:
        assert list(verify(reader).vectors.faults) == [seq]


def test_vectors_after_a_snapshot_are_checked_at_the_start(tmp_path: Path) -> None:
    fill(tmp_path)
    with open_ledger(tmp_path) as ledger:
        memory = open_memory(ledger)
        memory.write_snapshot(ledger, now=NOW)
        memory.store(episode("d"), REST_POSTURE, now=NOW)
        seq = memory.state["d"].seq
    with open_ledger(tmp_path) as ledger:
        assert len(open_memory(ledger)) == 4
    change(tmp_path, CHANGES["zeros"].format(seq=seq))
    with open_ledger(tmp_path) as ledger, pytest.raises(CorruptLedgerError, match=f"event {seq}"):
        open_memory(ledger)


def test_a_rebuild_restores_the_recorded_vectors_without_an_event(tmp_path: Path) -> None:
    seqs = fill(tmp_path)
    for name in ("zeros", "removed"):
        change(tmp_path, CHANGES[name].format(seq=seqs[0]))
        with open_ledger(tmp_path) as ledger:
            head = ledger.head()
            rebuild_vectors(ledger, JointEmbedding(HashingEncoder(32), CONFIG.limits, CONFIG.embedding))
            assert ledger.head() == head
            assert verify(ledger).is_intact
            assert len(open_memory(ledger)) == 3


def test_vectors_of_another_encoder_are_covered_after_a_rebuild(tmp_path: Path) -> None:
    seqs = fill(tmp_path)
    with open_ledger(tmp_path) as ledger:
        rebuild_vectors(ledger, JointEmbedding(HashingEncoder(16), CONFIG.limits, CONFIG.embedding))
        assert verify(ledger).is_intact
    change(tmp_path, CHANGES["bit"].format(seq=seqs[1]))
    with LedgerReader(tmp_path / "ledger.db") as reader:
        assert list(verify(reader).vectors.faults) == [seqs[1]]


def test_the_old_vectors_do_not_count_after_a_rebuild(tmp_path: Path) -> None:
    seqs = fill(tmp_path)
    database = sqlite3.connect(tmp_path / "ledger.db")
    old = database.execute("SELECT version, data, mask FROM vector WHERE seq = ?", (seqs[0],)).fetchone()
    database.close()
    with open_ledger(tmp_path) as ledger:
        rebuild_vectors(ledger, JointEmbedding(HashingEncoder(16), CONFIG.limits, CONFIG.embedding))
    database = sqlite3.connect(tmp_path / "ledger.db")
    database.execute("UPDATE vector SET version = ?, data = ?, mask = ? WHERE seq = ?", (*old, seqs[0]))
    database.commit()
    database.close()
    with LedgerReader(tmp_path / "ledger.db") as reader:
        assert list(verify(reader).vectors.faults) == [seqs[0]]


def test_a_changed_vector_is_not_compacted(tmp_path: Path) -> None:
    seq = fill(tmp_path)[1]
    change(tmp_path, CHANGES["bit"].format(seq=seq))
    with pytest.raises(CorruptLedgerError, match=f"event {seq}"):
        compact_in_place(tmp_path / "ledger.db", holder="a test", now=NOW, timeout_s=0.0)


def test_a_compacted_ledger_covers_its_vectors(tmp_path: Path) -> None:
    fill(tmp_path)
    compact_in_place(tmp_path / "ledger.db", holder="a test", now=NOW + 1, timeout_s=0.0)
    with LedgerReader(tmp_path / "ledger.db") as reader:
        found = verify(reader)
        assert (found.is_intact, found.vectors.checked, found.vectors.without_digest) == (True, 3, 0)
    change(tmp_path, "UPDATE vector SET data = zeroblob(length(data))")
    with LedgerReader(tmp_path / "ledger.db") as reader:
        assert len(verify(reader).vectors.faults) == 3


def test_a_ledger_without_digests_opens_and_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(ledger_module, "EPISODE", "no kind of event")  # as an earlier version wrote it
        fill(tmp_path)
    with open_ledger(tmp_path) as ledger:
        assert len(open_memory(ledger)) == 3
        found = verify(ledger)
        assert (found.is_intact, found.vectors.without_digest) == (True, 3)
        rebuild_vectors(ledger, JointEmbedding(HashingEncoder(32), CONFIG.limits, CONFIG.embedding))
        assert verify(ledger).vectors.without_digest == 0


def test_a_changed_event_is_found_when_it_is_read(tmp_path: Path) -> None:
    """An event before a snapshot is not read at the start, but before its text is shown to a planner."""
    seq = fill(tmp_path)[0]
    change(
        tmp_path,
        "DROP TRIGGER event_is_never_changed",
        f"UPDATE event SET payload = replace(payload, 'red cube', 'red mine') WHERE seq = {seq}",
    )
    with LedgerReader(tmp_path / "ledger.db") as reader, pytest.raises(CorruptLedgerError, match=f"event {seq}"):
        reader.event(seq)
