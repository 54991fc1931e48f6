"""A ledger file with objects that dualbrain did not create, or with links in place of its files, is refused."""

import os
import sqlite3
from pathlib import Path

import pytest

from dualbrain.errors import ConfigurationError
from dualbrain.memory.ledger.hash_chain import CorruptLedgerError
from dualbrain.memory.ledger.ledger import Ledger, LedgerReader, PendingEvent
from dualbrain.memory.maintenance.acceptance import accept_ledger
from dualbrain.memory.maintenance.verification import verify
from tests.memory.memory_samples import NOW, open_ledger

FOREIGN = {
    "trigger": "CREATE TRIGGER evil AFTER INSERT ON event BEGIN DELETE FROM vector; END",
    "temporary-like trigger": 'CREATE TRIGGER "e\'v;il" BEFORE INSERT ON vector BEGIN SELECT 1; END',
    "view": "CREATE VIEW evil AS SELECT * FROM event",
    "table": "CREATE TABLE evil (x)",
    "index": "CREATE INDEX evil ON event (hash)",
    "virtual table": "CREATE VIRTUAL TABLE evil USING fts5(x)",
    "statistics": "ANALYZE",
    "column": "ALTER TABLE event ADD COLUMN evil TEXT",
    "generated column": "ALTER TABLE event ADD COLUMN evil TEXT GENERATED ALWAYS AS ('x') VIRTUAL",
    "generated column of meta": "ALTER TABLE meta ADD COLUMN evil TEXT GENERATED ALWAYS AS ('2') VIRTUAL",
    "renamed column": "ALTER TABLE vector RENAME COLUMN mask TO veil",
    "instead of view": "CREATE TRIGGER event_is_never_read BEFORE DELETE ON vector BEGIN SELECT raise(IGNORE); END",
}
CHANGED = {
    "trigger": (
        "DROP TRIGGER event_is_never_changed",
        "CREATE TRIGGER event_is_never_changed BEFORE UPDATE ON event BEGIN SELECT 1; END",
    ),
    "index": ("DROP INDEX one_episode", "CREATE INDEX one_episode ON event (subject)"),
    "meta as a view": (
        "DROP TABLE meta",
        "CREATE VIEW meta AS WITH RECURSIVE n(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM n) "
        "SELECT 'schema_version' AS key, x AS value FROM n WHERE x < 0",
    ),
    "event as a view": ("ALTER TABLE event RENAME TO evil", "CREATE VIEW event AS SELECT * FROM evil"),
    "no vectors": ("DROP TABLE vector",),
}


@pytest.fixture
def path(tmp_path: Path) -> Path:
    with open_ledger(tmp_path) as ledger:
        ledger.append([PendingEvent(kind="note", subject="s", payload={})], now=NOW)
    return tmp_path / "ledger.db"


def execute(path: Path, *statements: str) -> None:
    database = sqlite3.connect(path, isolation_level=None)
    for statement in statements:
        database.execute(statement)
    database.close()


@pytest.mark.parametrize("statements", [*((one,) for one in FOREIGN.values()), *CHANGED.values()])
def test_a_foreign_or_changed_object_is_refused_before_anything_is_written(
    path: Path, statements: tuple[str, ...]
) -> None:
    execute(path, *statements)
    before = path.read_bytes()
    with pytest.raises(CorruptLedgerError, match=r"evil|v;il|never|one_episode|meta|event|vector|sqlite_stat1"):
        LedgerReader(path)
    for accept_faults in (False, True):
        with pytest.raises(CorruptLedgerError):
            Ledger(path, holder="a test", now=NOW, accept_faults=accept_faults)
    assert path.read_bytes() == before


def test_the_error_names_the_object_and_the_remedy(path: Path) -> None:
    execute(path, FOREIGN["trigger"])
    with pytest.raises(CorruptLedgerError, match=r"contains the trigger 'evil'.*DROP TRIGGER \"evil\"") as error:
        LedgerReader(path)
    execute(path, str(error.value).split("'")[3])  # the statement of the remedy
    LedgerReader(path).close()


@pytest.mark.parametrize("statement", ["DROP TRIGGER event_is_never_removed", "DROP INDEX one_episode"])
def test_a_missing_guard_is_reported_and_created_again_on_acceptance(path: Path, statement: str) -> None:
    execute(path, statement)
    with pytest.raises(CorruptLedgerError, match=r"is missing.*--accept REASON"):
        Ledger(path, holder="a test", now=NOW)
    with LedgerReader(path) as reader:
        found = verify(reader)
    assert not found.is_intact
    assert statement.rsplit(maxsplit=1)[-1] in found.file_faults[0]
    accept_ledger(path, "a test", holder="a test", now=NOW)
    with Ledger(path, holder="a test", now=NOW) as ledger:
        assert verify(ledger).is_intact
    with pytest.raises(sqlite3.IntegrityError):
        execute(path, "DELETE FROM event", "INSERT INTO event SELECT 9, 'episode', '', 'x', 0, x'', '', '' FROM meta")


def test_an_index_with_another_definition_than_its_entries_is_refused(path: Path) -> None:
    execute(
        path,
        "PRAGMA writable_schema = ON",
        "UPDATE sqlite_master SET sql = 'CREATE INDEX event_kind ON event (run, kind)' WHERE name = 'event_kind'",
    )
    with pytest.raises(CorruptLedgerError, match="event_kind"):
        LedgerReader(path)


@pytest.mark.parametrize("suffix", ["-wal", "-shm", "-journal", ".lock", ".anchor"])
@pytest.mark.parametrize("make", [lambda p: p.symlink_to(p.with_name("target")), os.mkfifo, lambda p: p.mkdir()])
def test_links_pipes_and_folders_beside_the_ledger_are_refused(path: Path, suffix: str, make) -> None:
    target = path.with_name("target")
    target.write_text("precious")
    other = path.with_name(path.name + suffix)
    other.unlink(missing_ok=True)
    make(other)
    with pytest.raises(ConfigurationError, match="not a regular file"):
        Ledger(path, holder="a test", now=NOW)
    with pytest.raises(ConfigurationError, match="not a regular file"):
        LedgerReader(path)
    assert target.read_text() == "precious"


@pytest.mark.parametrize("make", [os.mkfifo, Path.mkdir])
def test_a_pipe_or_a_folder_is_no_ledger(tmp_path: Path, make) -> None:
    make(tmp_path / "ledger.db")
    for opened in (lambda: open_ledger(tmp_path), lambda: LedgerReader(tmp_path / "ledger.db")):
        with pytest.raises(ConfigurationError, match="not a regular file"):
            opened()


def test_a_link_to_a_ledger_is_followed(path: Path, tmp_path: Path) -> None:
    (tmp_path / "linked.db").symlink_to(path)
    with Ledger(tmp_path / "linked.db", holder="a test", now=NOW) as ledger:
        assert ledger.head().seq == 1


def test_functions_of_the_file_are_not_trusted_and_extensions_are_off(path: Path) -> None:
    with LedgerReader(path) as reader, open_ledger(path.parent) as ledger:
        for one in (reader, ledger):
            assert one._store.database.execute("PRAGMA trusted_schema").fetchone() == (0,)
            with pytest.raises(sqlite3.OperationalError, match=r"not authorized|no such function"):
                one._store.database.execute("SELECT load_extension('x')")
