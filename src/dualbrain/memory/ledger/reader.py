"""Read-only view of a ledger: its events, the hash chain, and vectors that are compared with their digests."""

from __future__ import annotations

import math
import os
import sqlite3
from collections.abc import Generator, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from dualbrain.core.storage.sqlite import harden
from dualbrain.core.text import make_json_safe
from dualbrain.errors import DECODE_ERRORS, ConfigurationError, MissingDependencyError
from dualbrain.memory.ledger.anchors import anchor_path
from dualbrain.memory.ledger.hash_chain import (
    GENESIS,
    ChainReport,
    CorruptLedgerError,
    Head,
    LedgerEvent,
    event_digest,
    verify_chain,
)
from dualbrain.memory.ledger.ledger_files import check_files, tighten_files, unusable_ledger
from dualbrain.memory.ledger.schema_check import check_meta_table, check_objects
from dualbrain.memory.ledger.tables import SCHEMA_VERSION, read_schema_version
from dualbrain.memory.ledger.vectors import (
    DIGEST_EVENT_KINDS,
    StoredVector,
    VectorReport,
    find_vector_fault,
    recorded_digests,
)

COLUMNS = "seq, kind, run, subject, time, payload, previous, hash"
"""Columns of the event table."""
RECOMPUTE_VECTORS = "Recompute all vectors from the episodes with `dualbrain memory rebuild`, or restore a copy."
"""Remedy for vectors that are not those of the events."""


class LedgerReader:
    """Read-only view of a ledger; any number of readers may be open, also while a run writes."""

    def __init__(self, path: Path) -> None:
        """Open the ledger at `path`.

        Raises `MissingDependencyError` if there is no file, `ConfigurationError` if it cannot be used, and
        `CorruptLedgerError` if it is damaged.
        """
        if not path.exists():
            fix = (
                "Its anchor shows that it existed: restore a copy, or accept the loss with "
                f"`dualbrain memory verify --ledger {path} --accept REASON`."
                if anchor_path(path).exists()
                else "The first `dualbrain run` creates it."
            )
            raise MissingDependencyError(f"The memory ledger {path}", fix=fix)
        self.path = path
        check_files(path)
        with suppress(OSError):  # a read-only disk
            tighten_files(path)
        with self._translate_errors():
            self._database = sqlite3.connect(_database_uri(path), uri=True, isolation_level=None)
            try:
                self._check_schema()
            except BaseException:
                self._database.close()
                raise

    def _check_schema(self) -> None:
        """Decode damaged text without an error, and refuse an unknown schema version and foreign objects.

        Missing indices and triggers are stored in `missing_objects`: they do not matter to a reader.
        """
        self._database.text_factory = _decode_text
        harden(self._database)
        check_meta_table(self._database, self.path)
        self.schema = read_schema_version(self._database)
        if not self.schema:
            raise ConfigurationError.stating(
                f"The memory ledger {self.path} is empty: it has no tables.",
                fix="Remove it, so that the next `dualbrain run` creates a ledger.",
            )
        self.missing_objects = check_objects(self._database, self.path)

    def open_archive(self, path: Path) -> LedgerReader:
        """A reader of the archive at `path`, from which this ledger was compacted; same errors as `LedgerReader`."""
        return LedgerReader(path)

    @contextmanager
    def _translate_errors(self) -> Generator[None]:
        try:
            yield
        except sqlite3.OperationalError as error:
            raise unusable_ledger(str(error), self.path) from error
        except sqlite3.IntegrityError as error:
            sentence = f"The ledger already contains an episode or a run with this name ({error})."
            raise ConfigurationError.stating(sentence, fix="Use a new episode id or run name.") from error
        except sqlite3.DatabaseError as error:
            raise CorruptLedgerError(f"SQLite reports: {error}", seq=None, path=str(self.path)) from error

    def events(self, where: str = "", values: tuple[object, ...] = ()) -> Iterator[LedgerEvent]:
        """Events in order of `seq`; `where` is an SQL condition over the columns of the event table."""
        condition = f"WHERE {where}" if where else ""
        with self._translate_errors():
            query = f"SELECT {COLUMNS} FROM event {condition} ORDER BY seq"
            for row in self._database.execute(query, make_json_safe(list(values))):
                yield _parse_event_row(row)

    def head(self) -> Head:
        """Number and hash of the newest event; (0, `GENESIS`) in an empty ledger."""
        with self._translate_errors():
            row = self._database.execute("SELECT seq, hash FROM event ORDER BY seq DESC LIMIT 1").fetchone()
        return Head(row[0], row[1]) if row else Head(0, GENESIS)

    def verify(self, anchor: Head | None = None) -> ChainReport:
        """Check the whole chain (see `hash_chain.verify_chain`); an unreadable event is reported, too."""
        return verify_chain(self.events(), anchor)

    def find_database_faults(self) -> tuple[str, ...]:
        """Faults that SQLite finds in the structure of the file, such as an index without some events."""
        with self._translate_errors():
            rows = [str(row[0]) for row in self._database.execute("PRAGMA integrity_check(5)")]
        return () if rows == ["ok"] else tuple(rows)

    def event(self, seq: int) -> LedgerEvent:
        """The event with number `seq`, after a check of its content and of the link from the next event.

        Raises `CorruptLedgerError` if the event is missing or was changed.
        """
        for event in self.events("seq = ?", (seq,)):
            following = next(self.events("seq = ?", (seq + 1,)), None)
            if event_digest(event) != event.hash or (following is not None and following.previous != event.hash):
                raise CorruptLedgerError("its content does not match its hash", seq=seq, path=str(self.path))
            return event
        raise CorruptLedgerError("it is missing", seq=seq, path=str(self.path))

    def last_seq_before(self, time: float) -> int:
        """Number of the last event written at or before `time` [s, 1970 UTC]; 0 if there is none."""
        with self._translate_errors():
            row = self._database.execute("SELECT max(seq) FROM event WHERE time <= ?", (time,)).fetchone()
        return row[0] or 0

    def vectors(self, after: int = 0) -> Iterator[tuple[int, StoredVector]]:
        """Event number and vector of each episode after event `after`, each after a check of its recorded digest.

        Raises `ConfigurationError` for a ledger of an older schema version, and `CorruptLedgerError` for a vector that
        was changed, removed or added.
        """
        recorded, found = self._recorded_digests(after), set[int]()
        for seq, row in self._vector_rows(after):
            if fault := find_vector_fault(row, recorded.get(seq)):
                raise CorruptLedgerError(fault, seq=seq, path=str(self.path), fix=RECOMPUTE_VECTORS)
            found.add(seq)
            yield seq, StoredVector(*row)
        if missing := sorted(seq for seq, digest in recorded.items() if digest and seq not in found):
            fault = "its vector is missing"
            raise CorruptLedgerError(fault, seq=missing[0], path=str(self.path), fix=RECOMPUTE_VECTORS)

    def stored_vectors(self) -> Iterator[tuple[int, StoredVector]]:
        """Event number and vector of each episode without any check, for a comparison with recomputed vectors."""
        return ((seq, StoredVector(*row)) for seq, row in self._vector_rows(0))

    def verify_vectors(self) -> VectorReport:
        """Compare every vector with its recorded digest; raises `ConfigurationError` for an older schema version."""
        recorded, rows = self._recorded_digests(0), dict(self._vector_rows(0))
        faults = {seq: find_vector_fault(row, recorded.get(seq)) for seq, row in rows.items()}
        faults |= {seq: "its vector is missing" for seq, digest in recorded.items() if digest and seq not in rows}
        without_digest = sum(seq not in recorded for seq in rows)
        found = {seq: fault for seq, fault in sorted(faults.items()) if fault}
        return VectorReport(checked=len(rows), without_digest=without_digest, faults=found)

    def _vector_rows(self, after: int) -> Iterator[tuple[int, Any]]:
        if self.schema < SCHEMA_VERSION:
            fix = f"Migrate it with `dualbrain memory rebuild`. {self.path}"
            raise ConfigurationError("ledger schema_version", got=self.schema, allowed=str(SCHEMA_VERSION), fix=fix)
        with self._translate_errors():
            query = "SELECT seq, version, data, mask FROM vector WHERE seq > ? ORDER BY seq"
            for seq, *row in self._database.execute(query, (after,)):
                yield seq, tuple(row)

    def _recorded_digests(self, after: int) -> dict[int, str]:
        """Recorded digests of the vectors after event `after`."""
        kinds = ", ".join("?" * len(DIGEST_EVENT_KINDS))
        events = self.events(f"seq > ? AND kind IN ({kinds})", (after, *DIGEST_EVENT_KINDS))
        try:
            return {seq: digest for seq, digest in recorded_digests(events).items() if seq > after}
        except DECODE_ERRORS as error:
            fault = f"an event with digests of vectors is unreadable: {error}"
            raise CorruptLedgerError(fault, seq=None, path=str(self.path)) from error

    def close(self) -> None:
        """Close the file."""
        self._database.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, value: object, trace: TracebackType | None) -> None:
        self.close()


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
