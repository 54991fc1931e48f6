"""The append-only event ledger in SQLite, from which weights, statuses and vectors of memory are derived."""

from __future__ import annotations

import math
import os
import sqlite3
from collections.abc import Generator, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import msgspec

from dualbrain.core.storage.sqlite import transaction
from dualbrain.core.text import make_json_safe
from dualbrain.errors import ConfigurationError, MissingDependencyError
from dualbrain.memory.ledger import runs
from dualbrain.memory.ledger.events import EPISODE
from dualbrain.memory.ledger.hash_chain import (
    GENESIS,
    ChainReport,
    CorruptLedgerError,
    Head,
    LedgerEvent,
    event_digest,
    verify_chain,
)
from dualbrain.memory.ledger.runs import InterruptedRun
from dualbrain.memory.ledger.tables import MIGRATED, SCHEMA_VERSION, create_or_migrate, read_schema_version
from dualbrain.memory.ledger.writer_lock import LockHolder, WriterLock

_COLUMNS = "seq, kind, run, subject, time, payload, previous, hash"


@dataclass(frozen=True, slots=True, kw_only=True)
class PendingEvent:
    """An event to be appended: `payload` is any value that msgspec encodes as JSON; `vector` goes to the projection.

    `run` is the run that the event belongs to, None for the current run.
    """

    kind: str
    subject: str
    payload: object
    vector: StoredVector | None = None
    run: str | None = None


@dataclass(frozen=True, slots=True)
class StoredVector:
    """One row of the vector projection: `version` of its embedding and `data` as little-endian float32.

    Bit b of `mask` is set if block b is present (see `joint_embedding.BLOCKS`).
    """

    version: str
    data: bytes
    mask: int = 0


class LedgerReader:
    """Read-only view of a ledger; any number of readers may be open, also while a run writes."""

    def __init__(self, path: Path) -> None:
        """Open the ledger at `path`.

        Raises `MissingDependencyError` if there is no file, `ConfigurationError` if it cannot be used, and
        `CorruptLedgerError` if it is damaged.
        """
        if not path.exists():
            raise MissingDependencyError(f"The memory ledger {path}", fix="The first `dualbrain run` creates it.")
        self.path = path
        with self._translate_errors():
            self._database = sqlite3.connect(_database_uri(path), uri=True, isolation_level=None)
            self._check_schema()

    def _check_schema(self) -> None:
        """Decode damaged text without an error, and refuse an unknown schema version."""
        self._database.text_factory = _decode_text
        self.schema = read_schema_version(self._database)
        if not self.schema:
            raise ConfigurationError.stating(
                f"The memory ledger {self.path} is empty: it has no tables.",
                fix="Remove it, so that the next `dualbrain run` creates a ledger.",
            )

    @contextmanager
    def _translate_errors(self) -> Generator[None]:
        try:
            yield
        except sqlite3.OperationalError as error:
            raise _unusable_ledger(str(error), self.path) from error
        except sqlite3.IntegrityError as error:
            sentence = f"The ledger already contains an episode or a run with this name ({error})."
            raise ConfigurationError.stating(sentence, fix="Use a new episode id or run name.") from error
        except sqlite3.DatabaseError as error:
            raise CorruptLedgerError(f"SQLite reports: {error}", seq=None, path=str(self.path)) from error

    def events(self, where: str = "", values: tuple[object, ...] = ()) -> Iterator[LedgerEvent]:
        """Events in order of `seq`; `where` is an SQL condition over the columns of the event table."""
        condition = f"WHERE {where}" if where else ""
        with self._translate_errors():
            query = f"SELECT {_COLUMNS} FROM event {condition} ORDER BY seq"
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

    def event(self, seq: int) -> LedgerEvent:
        """The event with number `seq`; raises `CorruptLedgerError` if it is missing."""
        for event in self.events("seq = ?", (seq,)):
            return event
        raise CorruptLedgerError("it is missing", seq=seq, path=str(self.path))

    def last_seq_before(self, time: float) -> int:
        """Number of the last event written at or before `time` [s, 1970 UTC]; 0 if there is none."""
        with self._translate_errors():
            row = self._database.execute("SELECT max(seq) FROM event WHERE time <= ?", (time,)).fetchone()
        return row[0] or 0

    def vectors(self, after: int = 0) -> Iterator[tuple[int, StoredVector]]:
        """Event number and vector of each episode after event `after`.

        Raises `ConfigurationError` for a ledger of an older schema version.
        """
        if self.schema < SCHEMA_VERSION:
            fix = f"Migrate it with `dualbrain memory rebuild`. {self.path}"
            raise ConfigurationError("ledger schema_version", got=self.schema, allowed=str(SCHEMA_VERSION), fix=fix)
        with self._translate_errors():
            query = "SELECT seq, version, data, mask FROM vector WHERE seq > ? ORDER BY seq"
            for seq, version, data, mask in self._database.execute(query, (after,)):
                yield seq, StoredVector(version, data, mask)

    def close(self) -> None:
        """Close the file."""
        self._database.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, value: object, trace: TracebackType | None) -> None:
        self.close()


class Ledger(LedgerReader):
    """The only writer of a ledger. Each `append` is one transaction and one fsync: all or none of it is on disk.

    Promise: a process killed between any two statements leaves a valid chain with every acknowledged event.
    Assumption: the disk keeps all data after a successful fsync.
    """

    def __init__(self, path: Path, *, holder: str, now: float, timeout_s: float = 0.0) -> None:
        """Open or create the ledger at `path` as `holder` at `now` [s, 1970 UTC].

        Raises `LedgerInUseError` if another writer still holds it after `timeout_s`, and `ConfigurationError` if it
        cannot be written. A ledger of an older schema version is migrated, and an event records the migration.
        """
        self.path, self.opened_at, self._run = path, now, ""
        with _translate_os_errors(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            self._lock = WriterLock(path, LockHolder(os.getpid(), holder, now), timeout_s=timeout_s)
        try:
            with self._translate_errors():
                self._database = sqlite3.connect(path, isolation_level=None)
                found = self._create()
                self._check_schema()
            if 0 < found < SCHEMA_VERSION:
                self.append(
                    [PendingEvent(kind=MIGRATED, subject="", payload={"from": found, "to": SCHEMA_VERSION})], now=now
                )
        except BaseException:
            self._lock.release()
            raise

    def _create(self) -> int:
        mode = self._database.execute("PRAGMA journal_mode = WAL").fetchone()[0]
        if mode != "wal":
            fix = f"Use a local disk. {self.path}"
            raise ConfigurationError("SQLite journal mode of the ledger", got=mode, allowed="wal", fix=fix)
        self._database.execute("PRAGMA synchronous = FULL")
        return create_or_migrate(self._database)

    def append(self, entries: Sequence[PendingEvent], *, now: float) -> tuple[LedgerEvent, ...]:
        """Append `entries` to the chain, all or none, with the time `now` [s, 1970 UTC].

        Raises `ConfigurationError` if `now` is not finite, or an episode id or run name is in the ledger already.
        """
        if not math.isfinite(now):
            raise ConfigurationError("time of a ledger event", got=now, allowed="finite seconds since 1970 UTC")
        head, events = self.head(), list[LedgerEvent]()
        for entry in entries:
            event = _build_event(entry, self._run if entry.run is None else make_json_safe(entry.run), now, head)
            events.append(event)
            head = Head(event.seq, event.hash)
        with self._translate_errors(), transaction(self._database):
            for event, entry in zip(events, entries, strict=True):
                row = tuple(getattr(event, name) for name in LedgerEvent.__slots__)
                self._database.execute(f"INSERT INTO event ({_COLUMNS}) VALUES (?, ?, ?, ?, ?, ?, ?, ?)", row)
                if entry.vector is not None:
                    self._insert_vector(event.seq, entry.vector)
        return tuple(events)

    def replace_vectors(self, vectors: Mapping[int, StoredVector]) -> None:
        """Replace the whole vector projection by `vectors`; the events stay unchanged."""
        with self._translate_errors(), transaction(self._database):
            self._database.execute("DELETE FROM vector")
            for seq, vector in vectors.items():
                self._insert_vector(seq, vector)

    def _insert_vector(self, seq: int, vector: StoredVector) -> None:
        row = (seq, vector.version, vector.data, vector.mask)
        self._database.execute("INSERT INTO vector (seq, version, data, mask) VALUES (?, ?, ?, ?)", row)

    def start_run(self, run: str, details: object, *, now: float) -> tuple[InterruptedRun, ...]:
        """Begin `run`; records and returns the runs that were interrupted before it."""
        interrupted = self.interrupted_runs()
        closing = [
            PendingEvent(
                kind=runs.INTERRUPTED, subject="", payload={"after": one.last_activity, "found_by": run}, run=one.run
            )
            for one in interrupted
        ]
        self.append([*closing, PendingEvent(kind=runs.STARTED, subject="", payload=details, run=run)], now=now)
        self._run = make_json_safe(run)
        return interrupted

    def mark_progress(self, what: str, *, now: float) -> None:
        """Record the next step of the run in a few words, so that an interruption can be attributed to a step."""
        self.append([PendingEvent(kind=runs.MARKED, subject="", payload={"what": what})], now=now)

    def end_run(self, details: object, *, now: float) -> None:
        """End the run that `start_run` began."""
        self.append([PendingEvent(kind=runs.ENDED, subject="", payload=details)], now=now)
        self._run = ""

    def interrupted_runs(self) -> tuple[InterruptedRun, ...]:
        """Runs of earlier processes that started and never ended, oldest first.

        Only the writer can know this: a reader cannot distinguish an interrupted run from the current one.
        """
        ended = "SELECT run FROM event WHERE kind IN (?, ?)"
        where = f"kind = ? AND run <> ? AND run NOT IN ({ended})"
        open_runs = list(self.events(where, (runs.STARTED, self._run, runs.ENDED, runs.INTERRUPTED)))
        return tuple(self._describe_interrupted_run(start) for start in open_runs)

    def _describe_interrupted_run(self, start: LedgerEvent) -> InterruptedRun:
        events = list(self.events("run = ?", (start.run,)))
        episodes = sum(event.kind == EPISODE for event in events)
        return InterruptedRun(
            run=start.run,
            started=start.time,
            last_time=events[-1].time,
            last_activity=runs.describe_activity(events[-1]),
            episodes=episodes,
        )

    def checkpoint_wal(self) -> None:
        """Move the write-ahead log into the ledger file; raises `ConfigurationError` if a reader blocks this."""
        with self._translate_errors():
            busy = self._database.execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchone()[0]
        if busy:
            raise ConfigurationError.stating(
                f"Another process is reading the memory ledger {self.path}.", fix="Close it and try again."
            )

    def close(self) -> None:
        """Close the file and release the writer lock."""
        super().close()
        self._lock.release()


def _build_event(entry: PendingEvent, run: str, now: float, head: Head) -> LedgerEvent:
    payload = msgspec.json.encode(
        make_json_safe(msgspec.to_builtins(entry.payload, str_keys=True)), order="deterministic"
    )
    event = LedgerEvent(
        seq=head.seq + 1,
        kind=entry.kind,
        run=run,
        subject=make_json_safe(entry.subject),
        time=float(now),
        payload=payload,
        previous=head.hash,
        hash="",
    )
    return replace(event, hash=event_digest(event))


@contextmanager
def _translate_os_errors(path: Path) -> Generator[None]:
    try:
        yield
    except OSError as error:
        raise _unusable_ledger(error.strerror or str(error), path) from error


def _unusable_ledger(reason: str, path: Path) -> ConfigurationError:
    fix = "Check that this user can read and write the file, and that the disk has free space."
    return ConfigurationError.stating(f"The memory ledger {path} cannot be used: {reason}.", fix=fix)


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
