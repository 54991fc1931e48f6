"""Read-only view of a ledger: its events, the hash chain, and vectors that are compared with their digests."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from dualbrain.core.text import make_json_safe
from dualbrain.errors import DECODE_ERRORS, ConfigurationError, MissingDependencyError
from dualbrain.memory.ledger.anchors import anchor_path
from dualbrain.memory.ledger.events import VECTORS
from dualbrain.memory.ledger.hash_chain import (
    ChainReport,
    CorruptLedgerError,
    Head,
    LedgerEvent,
    event_digest,
    verify_chain,
)
from dualbrain.memory.ledger.shared.config import SharedLedgerConfig, is_shared
from dualbrain.memory.ledger.shared.replicated_store import ReplicatedStore
from dualbrain.memory.ledger.sqlite.store import SqliteStore
from dualbrain.memory.ledger.sqlite.tables import SCHEMA_VERSION
from dualbrain.memory.ledger.store import EventQuery, LedgerStore
from dualbrain.memory.ledger.vectors import (
    DIGEST_EVENT_KINDS,
    StoredVector,
    VectorReport,
    episode_digest,
    find_vector_fault,
    recorded_digests,
)

RECOMPUTE_VECTORS = "Recompute all vectors from the episodes with `dualbrain memory rebuild`, or restore a copy."
"""Remedy for vectors that are not those of the events."""


class LedgerReader:
    """Read-only view of a ledger; any number of readers may be open, also while a run writes.

    For the file of a shared ledger (see `shared.config`) it is a view of the replica on this machine.
    """

    def __init__(self, path: Path) -> None:
        """Open the ledger at `path`.

        Raises `MissingDependencyError` if there is no file, `ConfigurationError` if it cannot be used, and
        `CorruptLedgerError` if it is damaged.
        """
        if not path.exists() and anchor_path(path).exists():
            fix = (
                "Its anchor shows that it existed: restore a copy, or accept the loss with "
                f"`dualbrain memory verify --ledger {path} --accept REASON`."
            )
            raise MissingDependencyError(f"The memory ledger {path}", fix=fix)
        self.path, self.resources = path, ExitStack()
        self.notices: tuple[str, ...] = ()
        self._rebuilt: tuple[int, dict[int, str]] = (0, {})
        self._store: LedgerStore = _open_for_reading(path)

    @property
    def usable_writers(self) -> tuple[str, ...]:
        """The robots of a shared ledger whose memories may be retrieved and trained on; empty: all."""
        return self._store.config.use_memories_of if isinstance(self._store, ReplicatedStore) else ()

    @property
    def shared_config(self) -> SharedLedgerConfig | None:
        """The configuration of a shared ledger, None for a ledger of one robot."""
        return self._store.config if isinstance(self._store, ReplicatedStore) else None

    @property
    def schema(self) -> int:
        """Version of the tables."""
        return self._store.schema

    @property
    def missing_objects(self) -> tuple[str, ...]:
        """Declared indices and triggers that are missing: they do not matter to a reader."""
        return self._store.missing_objects

    def open_archive(self, path: Path) -> LedgerReader:
        """A reader of the archive at `path`, from which this ledger was compacted; same errors as `LedgerReader`."""
        return LedgerReader(path)

    def events(
        self,
        *kinds: str,
        subject: str | None = None,
        run: str | None = None,
        after: int = 0,
        until: int | None = None,
    ) -> Iterator[LedgerEvent]:
        """Events with `after` < seq ≤ `until` in this order; of these `kinds`, `subject` and `run`, each if given."""
        texts = [None if text is None else make_json_safe(text) for text in (subject, run)]
        query = EventQuery(kinds=kinds, subject=texts[0], run=texts[1], after=after, until=until)
        return self._store.events(query)

    def head(self) -> Head:
        """Number and hash of the newest event; (0, `GENESIS`) in an empty ledger."""
        return self._store.head()

    def verify(self, anchor: Head | None = None) -> ChainReport:
        """Check the whole chain (see `hash_chain.verify_chain`); an unreadable event is reported, too."""
        return verify_chain(self.events(), anchor)

    def find_database_faults(self) -> tuple[str, ...]:
        """Faults in the structure of the storage, such as an index without some events."""
        return self._store.find_faults()

    def event(self, seq: int) -> LedgerEvent:
        """The event with number `seq`, after a check of its content and of the link from the next event.

        Raises `CorruptLedgerError` if the event is missing or was changed.
        """
        found = {event.seq: event for event in self.events(after=seq - 1, until=seq + 1)}
        if (event := found.get(seq)) is None:
            raise CorruptLedgerError("it is missing", seq=seq, path=str(self.path))
        following = found.get(seq + 1)
        if event_digest(event) != event.hash or (following is not None and following.previous != event.hash):
            raise CorruptLedgerError("its content does not match its hash", seq=seq, path=str(self.path))
        return event

    def last_seq_before(self, time: float) -> int:
        """Number of the last event written at or before `time` [s, 1970 UTC]; 0 if there is none."""
        return self._store.last_seq_before(time)

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

    def selected_vectors(self, seqs: Sequence[int]) -> dict[int, StoredVector]:
        """The vectors of the episodes with these event numbers, each after a check of its recorded digest.

        An episode without a vector is left out. Raises `CorruptLedgerError` for a vector that was changed or added.
        """
        rebuilt = self._rebuilt_digests()
        found = dict[int, StoredVector]()
        for seq, row, payload in self._store.selected_vector_rows(seqs):
            try:
                digest = rebuilt.get(seq, episode_digest(payload))
            except DECODE_ERRORS as error:
                raise CorruptLedgerError(f"it is unreadable: {error}", seq=seq, path=str(self.path)) from error
            if fault := find_vector_fault(row, digest):
                raise CorruptLedgerError(fault, seq=seq, path=str(self.path), fix=RECOMPUTE_VECTORS)
            found[seq] = StoredVector(*row)  # pyright: ignore[reportArgumentType]
        return found

    def _rebuilt_digests(self) -> dict[int, str]:
        """Digests that were recorded when vectors were recomputed."""
        head = self.head().seq
        known, digests = self._rebuilt if self._rebuilt[0] <= head else (0, {})
        try:
            fresh = recorded_digests(self.events(VECTORS, after=known)) if known < head else {}
        except DECODE_ERRORS as error:
            fault = f"an event with digests of vectors is unreadable: {error}"
            raise CorruptLedgerError(fault, seq=None, path=str(self.path)) from error
        self._rebuilt = head, {**digests, **fresh} if fresh else digests
        return self._rebuilt[1]

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
        yield from self._store.vector_rows(after)

    def _recorded_digests(self, after: int) -> dict[int, str]:
        """Recorded digests of the vectors after event `after`."""
        events = self.events(*DIGEST_EVENT_KINDS, after=after)
        try:
            return {seq: digest for seq, digest in recorded_digests(events).items() if seq > after}
        except DECODE_ERRORS as error:
            fault = f"an event with digests of vectors is unreadable: {error}"
            raise CorruptLedgerError(fault, seq=None, path=str(self.path)) from error

    def close(self) -> None:
        """Close the storage, and the `resources` that others have registered."""
        with self.resources:
            self._store.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, value: object, trace: TracebackType | None) -> None:
        self.close()


def _open_for_reading(path: Path) -> LedgerStore:
    return ReplicatedStore.open_for_reading(path) if is_shared(path) else SqliteStore.open_for_reading(path)
