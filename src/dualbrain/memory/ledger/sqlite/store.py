"""The ledger in a SQLite file: one writer, any number of readers, one fsync for each append."""

from __future__ import annotations

import json
import math
import os
import sqlite3
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Self

from dualbrain.core.storage.private_files import open_private
from dualbrain.core.storage.sqlite import harden, transaction
from dualbrain.errors import ConfigurationError, MissingDependencyError
from dualbrain.memory.ledger.hash_chain import GENESIS, CorruptLedgerError, Head, LedgerEvent
from dualbrain.memory.ledger.sqlite.ledger_files import check_files, tighten_files, translate_os_errors, unusable_ledger
from dualbrain.memory.ledger.sqlite.schema_check import check_meta_table, check_objects, missing_objects_error
from dualbrain.memory.ledger.sqlite.tables import create_missing_guards, create_or_migrate, read_schema_version
from dualbrain.memory.ledger.store import (
    COLUMNS,
    ChainedEvent,
    EventBuilder,
    EventQuery,
    HeadMovedError,
    RefusedEntryError,
    VectorRow,
)
from dualbrain.memory.ledger.vectors import StoredVector


class SqliteStore:
    """The events and vectors in the file at `path`; see `LedgerStore`."""

    def __init__(self, database: sqlite3.Connection, path: Path) -> None:
        """Use an open `database`; see `open_for_reading` and `open_for_writing`."""
        self.database, self.path = database, path
        self.schema, self.migrated_from = 0, 0
        self.missing_objects: tuple[str, ...] = ()

    @classmethod
    def open_for_reading(cls, path: Path) -> Self:
        """Open the file at `path`; raises the errors of `LedgerReader`."""
        if not path.exists():
            raise MissingDependencyError(f"The memory ledger {path}", fix="The first `dualbrain run` creates it.")
        check_files(path)
        with suppress(OSError):  # a read-only disk
            tighten_files(path)
        with _translate_errors(path):
            store = cls(sqlite3.connect(_database_uri(path), uri=True, isolation_level=None), path)
            store._close_on_error(store._check_schema)
        return store

    @classmethod
    def open_for_writing(cls, path: Path, *, accept_faults: bool = False) -> Self:
        """Open, create or migrate the file at `path`, whose writer lock is held; raises the errors of `Ledger`.

        `migrated_from` is the schema version before a migration, else 0.
        """
        with translate_os_errors(path):
            open_private(path, "ab").close()  # SQLite gives its other files the same permissions
            tighten_files(path)
        with _translate_errors(path):
            store = cls(sqlite3.connect(path, isolation_level=None), path)
            store._close_on_error(lambda: store._prepare(accept_faults=accept_faults))
        return store

    def _close_on_error(self, check: Any) -> None:
        try:
            check()
        except BaseException:
            self.database.close()
            raise

    def _prepare(self, *, accept_faults: bool) -> None:
        """Check the file before the first change, then create or migrate its tables."""
        harden(self.database)
        check_meta_table(self.database, self.path)
        if read_schema_version(self.database):
            missing = check_objects(self.database, self.path)
            if missing and not accept_faults:
                raise missing_objects_error(missing, self.path)
            if missing:
                create_missing_guards(self.database)
        mode = self.database.execute("PRAGMA journal_mode = WAL").fetchone()[0]
        if mode != "wal":
            fix = f"Use a local disk. {self.path}"
            raise ConfigurationError("SQLite journal mode of the ledger", got=mode, allowed="wal", fix=fix)
        self.database.execute("PRAGMA synchronous = FULL")
        found = create_or_migrate(self.database)
        self._check_schema()
        self.migrated_from = found if found != self.schema else 0

    def _check_schema(self) -> None:
        """Decode damaged text without an error, and refuse an unknown schema version and foreign objects.

        Missing indices and triggers are stored in `missing_objects`: they do not matter to a reader.
        """
        self.database.text_factory = _decode_text
        harden(self.database)
        check_meta_table(self.database, self.path)
        self.schema = read_schema_version(self.database)
        if not self.schema:
            raise ConfigurationError.stating(
                f"The memory ledger {self.path} is empty: it has no tables.",
                fix="Remove it, so that the next `dualbrain run` creates a ledger.",
            )
        self.missing_objects = check_objects(self.database, self.path)

    def events(self, query: EventQuery) -> Iterator[LedgerEvent]:
        """See `LedgerStore`."""
        condition, values = query.condition()
        with _translate_errors(self.path):
            text = f"SELECT {COLUMNS} FROM event WHERE {condition} ORDER BY seq"
            for row in self.database.execute(text, values):
                yield _parse_event_row(row)

    def head(self) -> Head:
        """See `LedgerStore`."""
        with _translate_errors(self.path):
            row = self.database.execute("SELECT seq, hash FROM event ORDER BY seq DESC LIMIT 1").fetchone()
        return Head(row[0], row[1]) if row else Head(0, GENESIS)

    def last_seq_before(self, time: float) -> int:
        """See `LedgerStore`."""
        with _translate_errors(self.path):
            row = self.database.execute("SELECT max(seq) FROM event WHERE time <= ?", (time,)).fetchone()
        return row[0] or 0

    def vector_rows(self, after: int) -> Iterator[tuple[int, VectorRow]]:
        """See `LedgerStore`."""
        with _translate_errors(self.path):
            query = "SELECT seq, version, data, mask FROM vector WHERE seq > ? ORDER BY seq"
            for seq, version, data, mask in self.database.execute(query, (after,)):
                yield seq, (version, data, mask)

    def selected_vector_rows(self, seqs: Sequence[int]) -> Iterator[tuple[int, VectorRow, bytes]]:
        """See `LedgerStore`."""
        query = (
            "SELECT vector.seq, version, data, mask, payload FROM json_each(?) AS chosen "
            "CROSS JOIN vector ON vector.seq = chosen.value JOIN event ON event.seq = vector.seq"
        )
        with _translate_errors(self.path):
            for seq, version, data, mask, payload in self.database.execute(query, (json.dumps(sorted(seqs)),)):
                yield seq, (version, data, mask), payload

    def append(self, build: EventBuilder, *, after: Head | None = None) -> tuple[LedgerEvent, ...]:
        """See `LedgerStore`."""
        head = self.head()  # no other writer: the writer lock is held
        if after is not None and after != head:
            raise HeadMovedError(after, head)
        chained = build(head)
        with _translate_errors(self.path), transaction(self.database):
            self._insert(chained)
        return tuple(event for event, _ in chained)

    def replace_vectors(self, vectors: Mapping[int, StoredVector], build: EventBuilder) -> None:
        """See `LedgerStore`."""
        chained = build(self.head())
        with _translate_errors(self.path), transaction(self.database):
            self.database.execute("DELETE FROM vector")
            for seq, vector in vectors.items():
                self._insert_vector(seq, vector)
            self._insert(chained)

    def _insert(self, chained: Sequence[ChainedEvent]) -> None:
        for event, vector in chained:
            row = tuple(getattr(event, name) for name in LedgerEvent.__slots__)
            self.database.execute(f"INSERT INTO event ({COLUMNS}) VALUES (?, ?, ?, ?, ?, ?, ?, ?)", row)
            if vector is not None:
                self._insert_vector(event.seq, vector)

    def _insert_vector(self, seq: int, vector: StoredVector) -> None:
        row = (seq, vector.version, vector.data, vector.mask)
        self.database.execute("INSERT INTO vector (seq, version, data, mask) VALUES (?, ?, ?, ?)", row)

    def copy(
        self, events: Iterable[LedgerEvent], vectors: Callable[[], Iterable[tuple[int, StoredVector | None]]]
    ) -> None:
        """Insert `events` of another store as they are and then its `vectors` (None: remove it), all or none."""
        with _translate_errors(self.path), transaction(self.database):
            for event in events:
                self._insert([(event, None)])
            for seq, vector in vectors():
                self.database.execute("DELETE FROM vector WHERE seq = ?", (seq,))
                if vector is not None:
                    self._insert_vector(seq, vector)

    def find_faults(self) -> tuple[str, ...]:
        """Faults that SQLite finds in the structure of the file, such as an index without some events."""
        with _translate_errors(self.path):
            rows = [str(row[0]) for row in self.database.execute("PRAGMA integrity_check(5)")]
        return () if rows == ["ok"] else tuple(rows)

    def checkpoint_wal(self) -> None:
        """Move the write-ahead log into the ledger file; raises `ConfigurationError` if a reader blocks this."""
        with _translate_errors(self.path):
            busy = self.database.execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchone()[0]
        if busy:
            raise ConfigurationError.stating(
                f"Another process is reading the memory ledger {self.path}.", fix="Close it and try again."
            )

    def close(self) -> None:
        """Close the file."""
        self.database.close()


@contextmanager
def _translate_errors(path: Path) -> Generator[None]:
    try:
        yield
    except sqlite3.OperationalError as error:
        raise unusable_ledger(str(error), path) from error
    except sqlite3.IntegrityError as error:
        sentence = f"The ledger already contains an episode or a run with this name ({error})."
        raise RefusedEntryError.stating(sentence, fix="Use a new episode id or run name.") from error
    except sqlite3.DatabaseError as error:
        raise CorruptLedgerError(f"SQLite reports: {error}", seq=None, path=str(path)) from error


def _database_uri(path: Path) -> str:
    """The URI with which SQLite opens `path` for reading.

    In a folder without write permission and without a pending write-ahead log, the file is opened as immutable: SQLite
    cannot create its shared index there, and no process of this user can be writing.
    """
    log = path.with_name(f"{path.name}-wal")
    log_is_empty = not log.exists() or log.stat().st_size == 0
    immutable = log_is_empty and not os.access(path.parent, os.W_OK)
    return path.resolve().as_uri() + ("?immutable=1" if immutable else "?mode=ro")


def _decode_text(raw: bytes) -> str:
    return raw.decode("utf-8", "surrogateescape")


def _parse_event_row(row: tuple[Any, ...]) -> LedgerEvent:
    """The event in a database row, in which a damaged or forged file may hold values of any type."""
    seq, kind, run, subject, time, payload, previous, stored = row
    seconds = time if isinstance(time, float) else math.nan
    content = payload if isinstance(payload, bytes) else str(payload).encode("utf-8", "surrogateescape")
    return LedgerEvent(
        seq=seq,
        kind=str(kind),
        run=str(run),
        subject=str(subject),
        time=seconds,
        payload=content,
        previous=str(previous),
        hash=str(stored),
    )
