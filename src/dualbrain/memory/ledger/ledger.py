"""The append-only event ledger in SQLite, from which weights, statuses and vectors of memory are derived."""

from __future__ import annotations

import math
import os
import sqlite3
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

import msgspec

from dualbrain.core.storage.private_files import create_private_folder, open_private
from dualbrain.core.storage.sqlite import harden, transaction
from dualbrain.core.text import make_json_safe
from dualbrain.errors import ConfigurationError, DualbrainError
from dualbrain.memory.ledger import runs
from dualbrain.memory.ledger.anchors import AnchorMismatchError, anchor_path, check_anchors, write_anchor
from dualbrain.memory.ledger.events import EPISODE, VECTORS
from dualbrain.memory.ledger.hash_chain import Head, LedgerEvent, event_digest
from dualbrain.memory.ledger.ledger_files import check_files, tighten_files, translate_os_errors
from dualbrain.memory.ledger.reader import COLUMNS, LedgerReader
from dualbrain.memory.ledger.runs import InterruptedRun
from dualbrain.memory.ledger.schema_check import check_meta_table, check_objects, missing_objects_error
from dualbrain.memory.ledger.tables import (
    MIGRATED,
    SCHEMA_VERSION,
    create_missing_guards,
    create_or_migrate,
    read_schema_version,
)
from dualbrain.memory.ledger.vectors import DIGEST_FIELD, StoredVector, digest_changes, vector_digest
from dualbrain.memory.ledger.writer_lock import LockHolder, WriterLock

__all__ = ["Ledger", "LedgerReader", "PendingEvent", "StoredVector"]


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


class Ledger(LedgerReader):
    """The only writer of a ledger. Each `append` is one transaction and one fsync: all or none of it is on disk.

    Promise: a process killed between any two statements leaves a valid chain with every acknowledged event.
    Assumption: the disk keeps all data after a successful fsync.
    """

    def __init__(
        self,
        path: Path,
        *,
        holder: str,
        now: float,
        timeout_s: float = 0.0,
        run_folders: Sequence[Path] = (),
        accept_faults: bool = False,
    ) -> None:
        """Open or create the ledger at `path` as `holder` at `now` [s, 1970 UTC].

        The ledger is compared with the anchors beside it and in run folders (see `anchors.check_anchors`; `run_folders`
        are more folders of runs). With `accept_faults`, a ledger without the events of its anchors is opened all the
        same, and missing triggers are created again. A ledger of an older schema version is migrated, and an event
        records the migration. All files have mode 0600.

        Raises `LedgerInUseError` if another writer still holds it after `timeout_s`, `ConfigurationError` if it cannot
        be written, `AnchorMismatchError` if it was shortened, rewritten or replaced, and `CorruptLedgerError` if it is
        damaged or contains tables, triggers or views that dualbrain did not create.
        """
        self.path, self.opened_at, self._run = path, now, ""
        self._last_time, self._closed = now, False
        self._anchored: Head | None = None
        self.notices: tuple[str, ...] = ()
        with translate_os_errors(path):
            create_private_folder(path.parent)
            check_files(path)
            self._lock = WriterLock(path, LockHolder(os.getpid(), holder, now), timeout_s=timeout_s)
        try:
            with translate_os_errors(path):
                open_private(path, "ab").close()  # SQLite gives its other files the same permissions
                tighten_files(path)
            with self._translate_errors():
                self._database = sqlite3.connect(path, isolation_level=None)
                try:
                    self._open(now, run_folders, accept_faults=accept_faults)
                except BaseException:
                    self._database.close()
                    raise
        except BaseException:
            self._lock.release()
            raise

    def _open(self, now: float, run_folders: Sequence[Path], *, accept_faults: bool) -> None:
        """Check the file before the first change, then migrate it and compare it with its anchors."""
        harden(self._database)
        check_meta_table(self._database, self.path)
        if read_schema_version(self._database):
            missing = check_objects(self._database, self.path)
            if missing and not accept_faults:
                raise missing_objects_error(missing, self.path)
            if missing:
                create_missing_guards(self._database)
        found = self._create()
        self._check_schema()
        self.anchor_report = check_anchors(self, run_folders)
        self._run_folders = list(self.anchor_report.run_folders)
        self.notices += self.anchor_report.notices
        if self.anchor_report.faults and not accept_faults:
            raise AnchorMismatchError(self.anchor_report.faults, self.path)
        if 0 < found < SCHEMA_VERSION:
            self.append(
                [PendingEvent(kind=MIGRATED, subject="", payload={"from": found, "to": SCHEMA_VERSION})], now=now
            )
        if not self.anchor_report.faults:
            with translate_os_errors(self.path):
                self._write_anchor(now)

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
        events = self._build_events(entries, now)
        with self._translate_errors(), transaction(self._database):
            self._insert_events(events)
            for event, entry in zip(events, entries, strict=True):
                if entry.vector is not None:
                    self._insert_vector(event.seq, entry.vector)
        self._last_time = now
        return tuple(events)

    def replace_vectors(self, vectors: Mapping[int, StoredVector]) -> None:
        """Replace the whole vector projection by `vectors`, and append events with the digests that differ.

        A vector without a recorded digest gets one. All other events stay unchanged.
        """
        changes = digest_changes(self._recorded_digests(0), vectors)
        entries = [PendingEvent(kind=VECTORS, subject="", payload=change) for change in changes]
        events = self._build_events(entries, self._last_time)
        with self._translate_errors(), transaction(self._database):
            self._database.execute("DELETE FROM vector")
            for seq, vector in vectors.items():
                self._insert_vector(seq, vector)
            self._insert_events(events)

    def _build_events(self, entries: Sequence[PendingEvent], now: float) -> list[LedgerEvent]:
        head, events = self.head(), list[LedgerEvent]()
        for entry in entries:
            event = _build_event(entry, self._run if entry.run is None else make_json_safe(entry.run), now, head)
            events.append(event)
            head = Head(event.seq, event.hash)
        return events

    def _insert_events(self, events: Sequence[LedgerEvent]) -> None:
        for event in events:
            row = tuple(getattr(event, name) for name in LedgerEvent.__slots__)
            self._database.execute(f"INSERT INTO event ({COLUMNS}) VALUES (?, ?, ?, ?, ?, ?, ?, ?)", row)

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

    def anchor(self, path: Path | None = None) -> None:
        """Write the anchor of the newest event beside the ledger and, if given, to `path`; raises `FileWriteError`."""
        if path is not None:
            write_anchor(path, self, now=self._last_time)
            folder = str(path.resolve().parent.parent)
            if folder not in self._run_folders[-1:]:
                self._run_folders = [*(one for one in self._run_folders if one != folder), folder]
                self._anchored = None
        self._write_anchor(self._last_time)

    def _write_anchor(self, now: float) -> None:
        """Write the anchor beside the ledger, unless it is that of the newest event already."""
        if self._anchored != self.head():
            self._anchored = write_anchor(anchor_path(self.path), self, now=now, run_folders=self._run_folders)

    def close(self) -> None:
        """Write the anchor, close the file and release the writer lock; a second call does nothing.

        An anchor that cannot be written is a notice: the older one stays valid, and the next writer writes it again.
        """
        if self._closed:
            return
        self._closed = True
        try:
            if self._anchored is not None:
                self._write_anchor(self._last_time)
        except DualbrainError as error:
            self.notices += (f"The anchor of the memory ledger was not written: {error}",)
        finally:
            super().close()
            self._lock.release()


def _build_event(entry: PendingEvent, run: str, now: float, head: Head) -> LedgerEvent:
    content: Any = make_json_safe(msgspec.to_builtins(entry.payload, str_keys=True))
    if entry.kind == EPISODE and isinstance(content, dict):
        fields = cast("dict[str, Any]", content)
        fields.pop(DIGEST_FIELD, None)
        if entry.vector is not None:
            fields[DIGEST_FIELD] = vector_digest(entry.vector)
    payload = msgspec.json.encode(content, order="deterministic")
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
