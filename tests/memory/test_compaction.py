"""Compaction in place: the full ledger is replaced only by a complete file."""

import os
import sqlite3
from collections.abc import Iterator
from pathlib import Path

import pytest

from dualbrain.errors import ConfigurationError
from dualbrain.memory.ledger.events import FoldedUpdates
from dualbrain.memory.ledger.hash_chain import Head, LedgerEvent
from dualbrain.memory.ledger.ledger import Ledger, LedgerReader, PendingEvent
from dualbrain.memory.ledger.sqlite.store import SqliteStore
from dualbrain.memory.maintenance import compaction
from dualbrain.memory.maintenance.compaction import compact_in_place
from dualbrain.memory.state.derivation import derive_state
from tests.memory.memory_samples import NOW, REST_POSTURE, episode, open_ledger, open_memory


@pytest.fixture
def path(tmp_path: Path) -> Path:
    with open_ledger(tmp_path) as ledger:
        memory = open_memory(ledger)
        for number in range(3):
            memory.store(episode(f"e-{number}"), REST_POSTURE, now=NOW + number)
    return tmp_path / "ledger.db"


def compact(path: Path) -> Path:
    return compact_in_place(path, holder="a test", now=NOW + 60, timeout_s=0.0)


def contents(path: Path) -> tuple[Head, dict[str, float], list[LedgerEvent]]:
    """Head, weights and events of the ledger."""
    with LedgerReader(path) as reader:
        assert reader.verify().is_intact
        return reader.head(), derive_state(reader).weights(), list(reader.events())


def test_a_compaction_leaves_only_the_ledger_and_its_archive(path: Path) -> None:
    before = contents(path)
    archive = compact(path)
    assert contents(archive) == before
    assert contents(path)[1] == before[1]
    assert [file.name for file in path.parent.iterdir() if "compacting" in file.name] == []


def test_a_checkpoint_that_a_reader_blocks_leaves_the_full_ledger(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """SQLite itself reports no error if the log cannot be moved into the file when the file is closed."""
    before, readers, checkpoint = contents(path), list[sqlite3.Connection](), SqliteStore.checkpoint_wal

    def read_partial(source: LedgerReader) -> Iterator[PendingEvent]:
        reader = sqlite3.connect(path.with_name(f"{path.name}.compacting"))
        reader.execute("BEGIN")
        reader.execute("SELECT count(*) FROM event").fetchone()
        readers.append(reader)
        yield from ()

    def checkpoint_at_once(store: SqliteStore) -> None:
        store.database.execute("PRAGMA busy_timeout = 0")
        checkpoint(store)

    monkeypatch.setattr(compaction, "_accepted_events", read_partial)
    monkeypatch.setattr(SqliteStore, "checkpoint_wal", checkpoint_at_once)
    try:
        with pytest.raises(ConfigurationError, match=r"Another process is reading .*compacting"):
            compact(path)
    finally:
        readers[0].close()
    assert contents(path) == before
    monkeypatch.undo()
    compact(path)
    assert contents(path)[1] == before[1]


def test_a_log_with_events_is_never_left_behind(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before, checkpoint = contents(path), Ledger.checkpoint_wal

    def fill_again(ledger: Ledger) -> None:
        checkpoint(ledger)
        if ledger.path == path:
            ledger.append([PendingEvent(kind="note", subject="", payload="x")], now=NOW)

    monkeypatch.setattr(Ledger, "checkpoint_wal", fill_again)
    with pytest.raises(ConfigurationError, match=r"ledger\.db-wal is not empty"):
        compact(path)
    assert contents(path)[1] == before[1]
    assert not list(path.parent.glob("*.archive-*"))


def test_a_compacted_ledger_with_other_weights_does_not_replace_the_full_one(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = contents(path)

    def wrong(**fields: object) -> FoldedUpdates:
        return FoldedUpdates(**{**fields, "weight": 0.25})

    monkeypatch.setattr(compaction, "FoldedUpdates", wrong)
    with pytest.raises(ConfigurationError, match="differs from the full one"):
        compact(path)
    assert contents(path) == before


def test_the_folder_is_synced_before_and_after_the_replacement(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Otherwise a power failure may leave neither the archive nor the compacted ledger at its path."""
    steps, replace = list[str](), Path.replace

    def noting_replace(one: Path, other: Path) -> Path:
        if other == path:
            steps.append("replace")
        return replace(one, other)

    monkeypatch.setattr(compaction, "fsync_folder", lambda folder: steps.append(f"sync {folder.name}"))
    monkeypatch.setattr(Path, "replace", noting_replace)
    compact(path)
    assert steps == [f"sync {path.parent.name}", "replace", f"sync {path.parent.name}"]


def test_a_compaction_that_was_killed_after_the_link_can_be_repeated(path: Path) -> None:
    before = contents(path)
    with LedgerReader(path) as reader:
        archive = path.with_name(f"{path.name}.archive-{reader.head().seq}")
    os.link(path, archive)
    assert compact(path) == archive
    assert contents(archive) == before
    (again := path.with_name(f"{path.name}.archive-{contents(path)[0].seq}")).write_bytes(b"")
    with pytest.raises(ConfigurationError, match="exists already"):
        compact(path)
    assert again.read_bytes() == b""
