"""The laws of a store, for SQLite and PostgreSQL: the same events, the same hashes, appends after a known head."""

from collections.abc import Callable
from pathlib import Path

import psycopg
import pytest

from dualbrain.errors import ConfigurationError
from dualbrain.memory.ledger.hash_chain import GENESIS, Head, event_digest, verify_chain
from dualbrain.memory.ledger.ledger import PendingEvent, chain_events
from dualbrain.memory.ledger.postgres import connection
from dualbrain.memory.ledger.postgres.connection import check_address
from dualbrain.memory.ledger.postgres.store import PAGE, PostgresStore
from dualbrain.memory.ledger.sqlite.store import SqliteStore
from dualbrain.memory.ledger.store import EventBuilder, EventQuery, HeadMovedError, LedgerStore, ServerUnreachableError
from dualbrain.memory.ledger.vectors import StoredVector
from tests.memory.ledger.shared.robots import Lab
from tests.memory.memory_samples import NOW

HOSTILE = ("\x00\x1b[2J\u202e", "'; DROP TABLE event; --", "%s $1 ?", "\ufffd 🤖", "")
ENTRIES = [
    *(PendingEvent(kind="note", subject=text, payload={text: [text, 0.1, -0.0, 1e-320]}) for text in HOSTILE),
    PendingEvent(kind="episode", subject="e", payload={"a": 1}, vector=StoredVector("v", bytes(range(256)), 7)),
    PendingEvent(kind="run_started", subject="", payload=None, run="r\x00"),
]
GOLDEN = "eaee8085"
"""First digits of the hash of the last of `ENTRIES`, which no version of dualbrain may change."""


def build(*entries: PendingEvent) -> EventBuilder:
    return lambda head: chain_events(entries, run="r", now=NOW + 0.1, head=head)


@pytest.fixture(params=["sqlite", "postgres"])
def store(request: pytest.FixtureRequest, tmp_path: Path) -> LedgerStore:
    if request.param == "sqlite":
        return SqliteStore.open_for_writing(tmp_path / "ledger.sqlite")
    lab: Lab = request.getfixturevalue("lab")
    return lab.store


def test_events_are_read_exactly_and_the_chain_has_the_same_head_on_every_store(store: LedgerStore) -> None:
    assert store.head() == Head(0, GENESIS)
    written = store.append(build(*ENTRIES))
    assert tuple(store.events(EventQuery())) == written
    assert verify_chain(store.events(EventQuery())).head == store.head()
    assert store.head().hash[:8] == GOLDEN
    assert list(store.vector_rows(0)) == [(6, ("v", bytes(range(256)), 7))]
    assert list(store.vector_rows(6)) == []
    assert store.find_faults() == store.missing_objects == ()


@pytest.mark.parametrize(
    "query",
    [
        EventQuery(kinds=("note",), after=2),
        EventQuery(subject=HOSTILE[0]),
        EventQuery(subject=HOSTILE[1], kinds=("note", "episode")),
        EventQuery(run="r\x00"),
        EventQuery(until=3, after=1),
        EventQuery(kinds=("none",)),
    ],
    ids=range(6),
)
def test_a_query_gives_the_events_that_meet_every_condition(store: LedgerStore, query: EventQuery) -> None:
    written = store.append(build(*ENTRIES))
    expected = [
        one
        for one in written
        if (not query.kinds or one.kind in query.kinds)
        and query.subject in (None, one.subject)
        and query.run in (None, one.run)
        and query.after < one.seq <= (query.until or len(written))
    ]
    assert list(store.events(query)) == expected


def test_more_events_than_a_page_are_read_once_each(store: LedgerStore) -> None:
    n = 2 * PAGE
    vector = StoredVector("v", b"\0" * 4)
    store.append(build(*(PendingEvent(kind="note", subject="", payload=i, vector=vector) for i in range(n))))
    assert [event.seq for event in store.events(EventQuery())] == list(range(1, n + 1))
    assert [seq for seq, _ in store.vector_rows(0)] == list(range(1, n + 1))
    assert store.last_seq_before(NOW) == 0
    assert store.last_seq_before(NOW + 1) == n


def test_an_append_after_a_moved_head_and_a_failed_append_write_nothing(store: LedgerStore) -> None:
    note, episode = (PendingEvent(kind=kind, subject="e", payload=0) for kind in ("note", "episode"))
    first = store.append(build(episode), after=Head(0, GENESIS))
    with pytest.raises(HeadMovedError):
        store.append(build(note), after=Head(0, GENESIS))
    with pytest.raises(ConfigurationError, match="already contains an episode"):
        store.append(build(note, episode))
    assert tuple(store.events(EventQuery())) == first
    store.append(build(note), after=store.head())
    assert verify_chain(store.events(EventQuery())).is_intact


def test_replaced_vectors_and_their_event_are_stored_together(store: LedgerStore) -> None:
    store.append(build(*ENTRIES))
    new = StoredVector("w", b"\1\2\3\4", 1)
    store.replace_vectors({6: new}, build(PendingEvent(kind="vectors", subject="", payload={})))
    assert list(store.vector_rows(0)) == [(6, ("w", b"\1\2\3\4", 1))]
    assert store.head().seq == len(ENTRIES) + 1


# --- PostgreSQL only ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "statement",
    [
        "UPDATE {}.event SET time = 0",
        "DELETE FROM {}.event WHERE seq = 7",
        "TRUNCATE {}.event CASCADE",
        "INSERT INTO {0}.event SELECT seq + 2, kind, run, 'x', time, payload, hash, hash FROM {0}.event WHERE seq = 7",
        "INSERT INTO {0}.event SELECT seq + 1, kind, run, 'x', time, payload, 'x', hash FROM {0}.event WHERE seq = 7",
    ],
    ids=["update", "delete", "truncate", "gap", "previous"],
)
def test_the_server_refuses_changes_of_events_and_a_gap_in_the_chain(lab: Lab, statement: str) -> None:
    lab.store.append(build(*ENTRIES))
    head = lab.store.head()
    with pytest.raises(psycopg.errors.RestrictViolation):
        lab.store.connection.execute(statement.format(lab.namespace).encode())
    assert lab.store.head() == head
    assert lab.store.find_faults() == ()


def test_a_missing_trigger_a_foreign_trigger_and_a_forged_event_are_faults(lab: Lab) -> None:
    lab.store.append(build(*ENTRIES))
    execute: Callable[[bytes], object] = lab.store.connection.execute
    table = f"{lab.namespace}.event".encode()
    execute(b"ALTER TABLE " + table + b" DISABLE TRIGGER event_is_never_changed")
    execute(b"UPDATE " + table + b" SET payload = '2' WHERE seq = 3")
    execute(
        b"CREATE TRIGGER extra BEFORE INSERT ON " + table + b" FOR EACH ROW EXECUTE FUNCTION "
        b"suppress_redundant_updates_trigger()"
    )
    missing, foreign, broken = lab.store.find_faults()
    assert missing == "the trigger 'event_is_never_changed' is missing on the server"
    assert "the trigger 'extra'" in foreign
    assert "broken at event 3" in broken


def test_a_forged_event_with_a_new_hash_is_a_fault_of_the_next_link(lab: Lab) -> None:
    written = lab.store.append(build(*ENTRIES))
    table = f"{lab.namespace}.event".encode()
    lab.store.connection.execute(b"ALTER TABLE " + table + b" DISABLE TRIGGER ALL")
    digest = event_digest(written[2]).replace("a", "b").encode()
    lab.store.connection.execute(b"UPDATE " + table + b" SET hash = '" + digest + b"' WHERE seq = 3")
    lab.store.connection.execute(b"ALTER TABLE " + table + b" ENABLE TRIGGER ALL")
    (fault,) = lab.store.find_faults()
    assert "broken at event 3" in fault


def test_a_writer_waits_for_the_lock_of_another_before_it_reads_the_head(
    lab: Lab, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(connection, "STATEMENT_TIMEOUT_S", 0.3)
    other = PostgresStore.open(lab.url, lab.namespace)
    try:
        with lab.store.exclusive(), pytest.raises(ServerUnreachableError, match=r"timeout|no answer"):
            other.append(build(*ENTRIES))
    finally:
        other.close()
    assert lab.store.head() == Head(0, GENESIS)


def test_a_database_without_tables_is_refused_and_creating_them_twice_changes_nothing(lab: Lab) -> None:
    with pytest.raises(ConfigurationError, match=r"no memory ledger in the schema 'other'.*--create"):
        PostgresStore.open(lab.url, "other")
    lab.store.append(build(*ENTRIES))
    PostgresStore.open(lab.url, lab.namespace, create=True).close()
    assert lab.store.head().seq == len(ENTRIES)


@pytest.mark.parametrize(
    "url", ["postgresql://robot:secret@host/db", "host=h password=secret", "postgresql://h/db?password=secret"]
)
def test_a_password_in_the_url_is_refused_and_not_repeated(url: str) -> None:
    with pytest.raises(ConfigurationError, match=r"~/\.pgpass") as raised:
        check_address(url)
    assert "secret" not in str(raised.value)
