"""The hash chain: each event carries the digest of the one before it, so that no past event can change unseen."""

from __future__ import annotations

import hashlib
import struct
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from dualbrain.errors import DualbrainError

GENESIS = hashlib.sha256(b"dualbrain ledger, schema 1").hexdigest()
"""What the first event names as its predecessor; the same for all schemas, so that a migration keeps the chain."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LedgerEvent:
    """One line of the ledger.

    `time` [s] is when it was written, since 1970 UTC. `run` is the run that wrote it and `subject` the episode it is
    about ("" if none). `payload` is JSON in UTF-8 with sorted keys. `hash` = SHA-256 over all other fields.
    """

    seq: int
    kind: str
    run: str
    subject: str
    time: float
    payload: bytes
    previous: str
    hash: str


@dataclass(frozen=True, slots=True)
class Head:
    """The newest event: its number (0 in an empty ledger) and digest. Kept elsewhere it anchors the chain."""

    seq: int
    hash: str


@dataclass(frozen=True, slots=True)
class ChainReport:
    """What a walk over the chain found: how many events hold, and the number and fault of the first that does not."""

    events: int
    head: Head
    broken_at: int | None = None
    fault: str = ""

    @property
    def is_intact(self) -> bool:
        """True if every event is the one that was written."""
        return self.broken_at is None


class CorruptLedgerError(DualbrainError):
    """The ledger file is not what was written: an event was changed, removed or cannot be read."""

    def __init__(self, fault: str, *, seq: int | None, path: str) -> None:
        """Say what is wrong with which event and, last, where the file lies."""
        self.fault, self.seq, self.path = fault, seq, path
        where = "" if seq is None else f" at event {seq}"
        super().__init__(
            f"The memory ledger is damaged{where}: {fault}. Nothing was changed. Restore a copy, "
            f"or move the file away to begin with an empty memory. {path}"
        )


def event_digest(event: LedgerEvent) -> str:
    """SHA-256 over all fields but `hash`, each preceded by its length: no two different events have the same bytes."""
    texts = (event.kind, event.run, event.subject, event.previous)
    numbers = struct.pack("<qd", event.seq, event.time)
    fields = [numbers, *(text.encode("utf-8", "surrogateescape") for text in texts), event.payload]
    framed = (part for field in fields for part in (struct.pack("<q", len(field)), field))
    return hashlib.sha256(b"".join(framed)).hexdigest()


def find_link_fault(event: LedgerEvent, before: Head) -> str:
    """Why `event` cannot follow `before`; "" if it can."""
    if event.seq != before.seq + 1:
        return f"event {before.seq + 1} is missing, the next one found is {event.seq}"
    if event.previous != before.hash:
        return "it does not name the event before it as its predecessor"
    return "" if event_digest(event) == event.hash else "its content does not match its hash"


def verified_events(events: Iterable[LedgerEvent], path: str, *, after: Head | None = None) -> Iterator[LedgerEvent]:
    """The same events, each only after its link was checked; raises `DamagedLedger` at the first that is broken.

    They follow the event `after` (default: they begin the chain).
    """
    head = after or Head(0, GENESIS)
    for event in events:
        if fault := find_link_fault(event, head):
            raise CorruptLedgerError(fault, seq=head.seq + 1, path=path)
        head = Head(event.seq, event.hash)
        yield event


def verify_chain(events: Iterable[LedgerEvent], anchor: Head | None = None) -> ChainReport:
    """Check every link, and that the chain still passes through `anchor`.

    Promise: a change, insertion or removal of any event before the newest is found and its number reported. Removal of
    the newest events leaves a shorter, valid chain: only an `anchor` kept elsewhere (each episode file holds one) shows
    that. Whoever can rewrite the whole file and every anchor can forge a chain: it is evidence, not a signature.
    """
    head = Head(0, GENESIS)
    try:
        for event in events:
            fault = find_link_fault(event, head)
            if not fault and anchor is not None and event.seq == anchor.seq and event.hash != anchor.hash:
                fault = "it is not the event that the anchor saw"
            if fault:
                return ChainReport(head.seq, head, head.seq + 1, fault)
            head = Head(event.seq, event.hash)
    except DualbrainError as error:
        return ChainReport(head.seq, head, head.seq + 1, f"it cannot be read: {error}")
    if anchor is not None and anchor.seq > head.seq:
        missing = f"the ledger ends at event {head.seq}, but event {anchor.seq} had been written"
        return ChainReport(head.seq, head, head.seq + 1, missing)
    return ChainReport(head.seq, head)
