"""The append-only event ledger, from which weights, statuses and vectors of memory are derived."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

import msgspec

from dualbrain.core.storage.private_files import create_private_folder
from dualbrain.core.text import make_json_safe
from dualbrain.errors import ConfigurationError, DualbrainError
from dualbrain.memory.ledger import runs
from dualbrain.memory.ledger.anchors import AnchorMismatchError, anchor_path, check_anchors, write_anchor
from dualbrain.memory.ledger.events import EPISODE, VECTORS
from dualbrain.memory.ledger.hash_chain import Head, LedgerEvent, event_digest
from dualbrain.memory.ledger.reader import LedgerReader
from dualbrain.memory.ledger.runs import InterruptedRun
from dualbrain.memory.ledger.shared.config import is_shared
from dualbrain.memory.ledger.shared.replicated_store import ReplicatedStore
from dualbrain.memory.ledger.shared.spool import Spool, WaitingEvent, WaitingItem
from dualbrain.memory.ledger.sqlite.ledger_files import check_files, translate_os_errors
from dualbrain.memory.ledger.sqlite.store import SqliteStore
from dualbrain.memory.ledger.sqlite.tables import MIGRATED, SCHEMA_VERSION
from dualbrain.memory.ledger.store import ChainedEvent, LedgerStore, ServerUnreachableError
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
        self.path, self.resources = path, ExitStack()
        self.opened_at, self._run = now, ""
        self._last_time, self._closed = now, False
        self._anchored: Head | None = None
        self.notices = ()
        self._rebuilt = (0, {})
        with translate_os_errors(path):
            create_private_folder(path.parent)
            check_files(path)
            self._lock = WriterLock(path, LockHolder(os.getpid(), holder, now), timeout_s=timeout_s)
        try:
            self._store = self._open_store(path, accept_faults=accept_faults)
            try:
                self._check_anchors(now, run_folders, accept_faults=accept_faults)
            except BaseException:
                self._store.close()
                raise
        except BaseException:
            self._lock.release()
            raise
        self.spool = Spool(path.with_name(f"{path.name}.spool"))
        self._run = self.qualify("")

    @staticmethod
    def _open_store(path: Path, *, accept_faults: bool) -> LedgerStore:
        opened = ReplicatedStore if is_shared(path) else SqliteStore
        return opened.open_for_writing(path, accept_faults=accept_faults)

    def _check_anchors(self, now: float, run_folders: Sequence[Path], *, accept_faults: bool) -> None:
        """Compare the ledger with its anchors, and record a migration."""
        self.anchor_report = check_anchors(self, run_folders)
        self._run_folders = list(self.anchor_report.run_folders)
        self.notices += self.anchor_report.notices
        if self.anchor_report.faults and not accept_faults:
            raise AnchorMismatchError(self.anchor_report.faults, self.path)
        if isinstance(self._store, SqliteStore) and self._store.migrated_from:
            payload = {"from": self._store.migrated_from, "to": SCHEMA_VERSION}
            self.append([PendingEvent(kind=MIGRATED, subject="", payload=payload)], now=now)
        if not self.anchor_report.faults:
            with translate_os_errors(self.path):
                self._write_anchor(now)

    def append(
        self,
        entries: Sequence[PendingEvent],
        *,
        now: float,
        after: Head | None = None,
        before_commit: Callable[[Head], None] | None = None,
    ) -> tuple[LedgerEvent, ...]:
        """Append `entries` to the chain, all or none, with the time `now` [s, 1970 UTC].

        `before_commit` is called with the first event before anything is written; if it raises, nothing is written.
        Raises `ConfigurationError` if `now` is not finite, or an episode id or run name is in the ledger already, and
        `HeadMovedError` if `after` is given and is not the newest event.
        """
        if not math.isfinite(now):
            raise ConfigurationError("time of a ledger event", got=now, allowed="finite seconds since 1970 UTC")

        def build(head: Head) -> list[ChainedEvent]:
            chained = self._chain(entries, now, head)
            if chained and before_commit is not None:
                first = chained[0][0]
                before_commit(Head(first.seq, first.hash))
            return chained

        events = self._store.append(build, after=after)
        self._last_time = now
        return events

    def replace_vectors(self, vectors: Mapping[int, StoredVector]) -> None:
        """Replace the whole vector projection by `vectors`, and append events with the digests that differ.

        A vector without a recorded digest gets one. All other events stay unchanged.
        """
        changes = digest_changes(self._recorded_digests(0), vectors)
        entries = [PendingEvent(kind=VECTORS, subject="", payload=change) for change in changes]
        self._store.replace_vectors(vectors, lambda head: self._chain(entries, self._last_time, head))

    def _chain(self, entries: Sequence[PendingEvent], now: float, head: Head) -> list[ChainedEvent]:
        return chain_events(entries, run=self._run, now=now, head=head)

    # --- a shared ledger --------------------------------------------------------------------------------------------

    @property
    def is_shared(self) -> bool:
        """Whether other robots write this ledger, too."""
        return isinstance(self._store, ReplicatedStore)

    @property
    def run(self) -> str:
        """The current run; of a shared ledger with the name of this robot."""
        return self._run

    def qualify(self, name: str) -> str:
        """The `name` of a run or an episode in this ledger: in a shared one, the name of this robot precedes it."""
        return f"{self._store.config.name}/{name}" if isinstance(self._store, ReplicatedStore) else name

    def receive(self) -> bool:
        """Copy the events that other robots have appended; returns whether the server answered (False: not shared).

        Raises `CorruptLedgerError` if they do not continue the ledger.
        """
        if not isinstance(self._store, ReplicatedStore):
            return False
        try:
            self._store.pull()
        except ServerUnreachableError:
            return False
        return True

    @contextmanager
    def exclusive(self) -> Generator[None]:
        """In the body, no other robot can append; raises `ServerUnreachableError`."""
        with self._store.exclusive() if isinstance(self._store, ReplicatedStore) else nullcontext():
            yield

    def contains(self, heads: Sequence[Head]) -> bool:
        """Whether the ledger contains one of the events `heads`."""
        return any(event.hash == one.hash for one in heads for event in self.events(after=one.seq - 1, until=one.seq))

    def record(self, entries: Sequence[PendingEvent], *, now: float) -> None:
        """Append events on which nothing depends; they wait in the spool while the server of a shared ledger is away.

        Raises the errors of `append`, and `FileWriteError` if the disk does not keep them.
        """
        try:
            self.append(entries, now=now)
        except ServerUnreachableError as error:
            heads = () if error.attempted is None else (error.attempted,)
            events = tuple(_waiting_event(entry, self._run) for entry in entries)
            self.spool.add(WaitingItem(time=now, events=events, attempts=heads))

    # --- runs -------------------------------------------------------------------------------------------------------

    def start_run(self, run: str, details: object, *, now: float) -> tuple[InterruptedRun, ...]:
        """Begin `run`; records and returns the runs that were interrupted before it."""
        run = self.qualify(run)
        interrupted = self.interrupted_runs()
        closing = [
            PendingEvent(
                kind=runs.INTERRUPTED, subject="", payload={"after": one.last_activity, "found_by": run}, run=one.run
            )
            for one in interrupted
        ]
        self.record([*closing, PendingEvent(kind=runs.STARTED, subject="", payload=details, run=run)], now=now)
        self._run = make_json_safe(run)
        return interrupted

    def mark_progress(self, what: str, *, now: float) -> None:
        """Record the next step of the run in a few words, so that an interruption can be attributed to a step."""
        self.record([PendingEvent(kind=runs.MARKED, subject="", payload={"what": what})], now=now)

    def end_run(self, details: object, *, now: float) -> None:
        """End the run that `start_run` began."""
        self.record([PendingEvent(kind=runs.ENDED, subject="", payload=details)], now=now)
        self._run = self.qualify("")

    def interrupted_runs(self) -> tuple[InterruptedRun, ...]:
        """Runs of earlier processes that started and never ended, oldest first.

        Only the writer can know this: a reader cannot distinguish an interrupted run from the current one. Of a shared
        ledger, only runs of this robot; none while events of them wait for the server.
        """
        if len(self.spool):
            return ()
        ended = {event.run for event in self.events(runs.ENDED, runs.INTERRUPTED)}
        started = self.events(runs.STARTED)
        open_runs = [event for event in started if event.run not in ended and self._is_earlier(event.run)]
        return tuple(self._describe_interrupted_run(start) for start in open_runs)

    def _is_earlier(self, run: str) -> bool:
        return run != self._run and run.startswith(self.qualify(""))

    def _describe_interrupted_run(self, start: LedgerEvent) -> InterruptedRun:
        events = list(self.events(run=start.run))
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
        if isinstance(self._store, SqliteStore):
            self._store.checkpoint_wal()

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


def chain_events(entries: Sequence[PendingEvent], *, run: str, now: float, head: Head) -> list[ChainedEvent]:
    """The events of `entries`, chained to `head`; those without a run of their own belong to `run`."""
    chained = list[ChainedEvent]()
    for entry in entries:
        event = _build_event(entry, run if entry.run is None else make_json_safe(entry.run), now, head)
        chained.append((event, entry.vector))
        head = Head(event.seq, event.hash)
    return chained


def _waiting_event(entry: PendingEvent, run: str) -> WaitingEvent:
    content = make_json_safe(msgspec.to_builtins(entry.payload, str_keys=True))
    return WaitingEvent(
        kind=entry.kind,
        subject=make_json_safe(entry.subject),
        run=run if entry.run is None else make_json_safe(entry.run),
        payload=msgspec.Raw(msgspec.json.encode(content)),
    )


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
