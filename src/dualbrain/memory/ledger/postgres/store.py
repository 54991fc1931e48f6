"""The ledger in a PostgreSQL database: several writers, which append one after the other to one hash chain."""

from __future__ import annotations

from collections.abc import Generator, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from typing import Any, Self

import psycopg
from psycopg import sql

from dualbrain.memory.ledger.hash_chain import GENESIS, Head, LedgerEvent, verify_chain
from dualbrain.memory.ledger.postgres.connection import connect, translated_errors
from dualbrain.memory.ledger.postgres.tables import TRIGGERS, check_tables, create_tables, list_triggers, lock_key
from dualbrain.memory.ledger.sqlite.tables import SCHEMA_VERSION
from dualbrain.memory.ledger.store import (
    COLUMNS,
    ChainedEvent,
    EventBuilder,
    EventQuery,
    HeadMovedError,
    ServerUnreachableError,
    VectorRow,
)
from dualbrain.memory.ledger.vectors import StoredVector

PAGE = 500
"""Number of rows that one statement reads."""


class PostgresStore:
    """The events and vectors in the schema `namespace` of a database; see `LedgerStore`.

    A writer holds an advisory lock from before it reads the head until its commit, so that events of several robots
    form one chain. Promise: an append is committed with all its events and vectors, or not at all.
    Assumption: the server keeps all data after a commit (`fsync` and `synchronous_commit` are on).
    """

    def __init__(self, connection: psycopg.Connection[tuple[Any, ...]], namespace: str) -> None:
        """Use an open `connection`; raises `ConfigurationError` if there are no tables in `namespace`."""
        self.connection, self.namespace = connection, namespace
        self.schema = SCHEMA_VERSION
        self._event, self._embedding = (sql.Identifier(namespace, name) for name in ("event", "embedding"))
        with translated_errors():
            self.missing_objects = check_tables(connection, namespace)

    @classmethod
    def open(cls, url: str, namespace: str, *, create: bool = False) -> Self:
        """Connect to the server at `url`; with `create`, missing tables are created.

        Raises `ServerUnreachableError` and `ConfigurationError`.
        """
        connection = connect(url)
        try:
            if create:
                with translated_errors():
                    create_tables(connection, namespace)
            return cls(connection, namespace)
        except BaseException:
            connection.close()
            raise

    @property
    def is_open(self) -> bool:
        """Whether the connection is usable."""
        return not self.connection.closed

    def events(self, query: EventQuery) -> Iterator[LedgerEvent]:
        """See `LedgerStore`; rows are read page by page."""
        columns = sql.SQL(COLUMNS)
        while True:
            exact = replace(query, subject=None, run=None)
            condition, values = exact.condition()
            for column, text in (("subject", query.subject), ("run", query.run)):
                if text is not None:
                    condition += f" AND {column} = ?"
                    values.append(_to_bytes(text))
            where = sql.SQL(condition.replace("?", "%s"))  # pyright: ignore[reportArgumentType]
            select = sql.SQL("SELECT {} FROM {} WHERE {} ORDER BY seq LIMIT {}").format(
                columns, self._event, where, sql.Literal(PAGE)
            )
            with translated_errors():
                rows = self.connection.execute(select, values).fetchall()
            yield from map(_parse_row, rows)
            if len(rows) < PAGE:
                return
            query = replace(query, after=rows[-1][0])

    def head(self) -> Head:
        """See `LedgerStore`."""
        with translated_errors():
            return self._head()

    def _head(self) -> Head:
        query = sql.SQL("SELECT seq, hash FROM {} ORDER BY seq DESC LIMIT 1").format(self._event)
        row = self.connection.execute(query).fetchone()
        return Head(row[0], row[1]) if row else Head(0, GENESIS)

    def last_seq_before(self, time: float) -> int:
        """See `LedgerStore`."""
        query = sql.SQL("SELECT max(seq) FROM {} WHERE time <= %s").format(self._event)
        with translated_errors():
            row = self.connection.execute(query, (time,)).fetchone()
        return (row[0] if row else 0) or 0

    def selected_vector_rows(self, seqs: Sequence[int]) -> Iterator[tuple[int, VectorRow, bytes]]:
        """See `LedgerStore`."""
        select = sql.SQL(
            "SELECT v.seq, version, data, mask, payload FROM {} AS v JOIN {} AS e USING (seq) "
            "WHERE seq = ANY(%s) ORDER BY seq"
        )
        with translated_errors():
            rows = self.connection.execute(select.format(self._embedding, self._event), (list(seqs),)).fetchall()
        for seq, version, data, mask, payload in rows:
            yield seq, (version, bytes(data), mask), bytes(payload)

    def vector_rows(self, after: int) -> Iterator[tuple[int, VectorRow]]:
        """See `LedgerStore`; rows are read page by page."""
        select = sql.SQL("SELECT seq, version, data, mask FROM {} WHERE seq > %s ORDER BY seq LIMIT {}")
        query = select.format(self._embedding, sql.Literal(PAGE))
        while True:
            with translated_errors():
                rows = self.connection.execute(query, (after,)).fetchall()
            for seq, version, data, mask in rows:
                yield seq, (version, bytes(data), mask)
            if len(rows) < PAGE:
                return
            after = rows[-1][0]

    def append(self, build: EventBuilder, *, after: Head | None = None) -> tuple[LedgerEvent, ...]:
        """See `LedgerStore`. If the server stops answering, `ServerUnreachableError` names the first event."""
        return tuple(event for event, _ in self.append_chained(build, after=after))

    def append_chained(self, build: EventBuilder, *, after: Head | None = None) -> Sequence[ChainedEvent]:
        """Like `append`; returns the events with their vectors."""
        with self._writing(build, after) as chained:
            self._insert(chained)
        return chained

    def replace_vectors(self, vectors: Mapping[int, StoredVector], build: EventBuilder) -> None:
        """See `LedgerStore`."""
        with self._writing(build, None) as chained:
            self.connection.execute(sql.SQL("DELETE FROM {}").format(self._embedding))
            self._insert_vectors(list(vectors.items()))
            self._insert(chained)

    @contextmanager
    def _writing(self, build: EventBuilder, after: Head | None) -> Generator[Sequence[ChainedEvent]]:
        """A transaction with the events that `build` chains to the head."""
        attempted: Head | None = None
        try:
            with translated_errors(), self.connection.transaction():
                # a statement of its own: the head is read after the lock is held
                self.connection.execute("SELECT pg_advisory_xact_lock(%s)", (lock_key(self.namespace),))
                head = self._head()
                if after is not None and after != head:
                    raise HeadMovedError(after, head)
                chained = build(head)
                attempted = Head(chained[0][0].seq, chained[0][0].hash) if chained else None
                yield chained
        except ServerUnreachableError as error:
            error.attempted = attempted
            raise

    def _insert(self, chained: Sequence[ChainedEvent]) -> None:
        rows = [_to_row(event) for event, _ in chained]
        marks = sql.SQL("%s, %s, %s, %s, %s, %s, %s, %s")
        insert = sql.SQL("INSERT INTO {} ({}) VALUES ({})").format(self._event, sql.SQL(COLUMNS), marks)
        with self.connection.cursor() as cursor:
            cursor.executemany(insert, rows)
        self._insert_vectors([(event.seq, vector) for event, vector in chained if vector is not None])

    def _insert_vectors(self, vectors: Sequence[tuple[int, StoredVector]]) -> None:
        insert = sql.SQL("INSERT INTO {} (seq, version, data, mask) VALUES (%s, %s, %s, %s)").format(self._embedding)
        if vectors:
            with self.connection.cursor() as cursor:
                cursor.executemany(insert, [(seq, one.version, one.data, one.mask) for seq, one in vectors])

    @contextmanager
    def exclusive(self) -> Generator[None]:
        """In the body, no other writer can append; this connection can."""
        key = (lock_key(self.namespace),)
        with translated_errors():
            self.connection.execute("SELECT pg_advisory_lock(%s)", key)
        try:
            yield
        finally:
            with suppress(psycopg.Error):  # a closed connection has released its locks
                self.connection.execute("SELECT pg_advisory_unlock(%s)", key)

    @contextmanager
    def snapshot(self) -> Generator[None]:
        """In the body, every read sees the ledger as it is at the beginning."""
        with translated_errors(), self.connection.transaction():
            self.connection.execute("SET TRANSACTION ISOLATION LEVEL REPEATABLE READ, READ ONLY")
            yield

    def find_faults(self) -> tuple[str, ...]:
        """Missing and foreign triggers, missing indices, and the first event that does not fit the chain."""
        with translated_errors():
            missing = check_tables(self.connection, self.namespace)
            foreign = sorted(list_triggers(self.connection, self.namespace) - set(TRIGGERS))
        chain = verify_chain(self.events(EventQuery()))
        faults = [f"the {name} is missing on the server" for name in missing]
        faults += [f"the server has the trigger {name!r}, which dualbrain did not create" for name in foreign]
        if not chain.is_intact:
            faults.append(f"the chain on the server is broken at event {chain.broken_at}: {chain.fault}")
        return tuple(faults)

    def close(self) -> None:
        """Close the connection."""
        self.connection.close()


def _to_bytes(text: str) -> bytes:
    return text.encode("utf-8", "surrogateescape")


def _to_row(event: LedgerEvent) -> tuple[object, ...]:
    run, subject = _to_bytes(event.run), _to_bytes(event.subject)
    return (event.seq, event.kind, run, subject, event.time, event.payload, event.previous, event.hash)


def _parse_row(row: tuple[Any, ...]) -> LedgerEvent:
    seq, kind, run, subject, time, payload, previous, stored = row
    texts = [bytes(value).decode("utf-8", "surrogateescape") for value in (run, subject)]
    return LedgerEvent(
        seq=seq,
        kind=kind,
        run=texts[0],
        subject=texts[1],
        time=time,
        payload=bytes(payload),
        previous=previous,
        hash=stored,
    )
