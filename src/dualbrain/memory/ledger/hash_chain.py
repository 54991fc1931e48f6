"""The hash chain: each event contains the digest of the previous event, so that changes of past events are detected."""

from __future__ import annotations

import hashlib
import struct
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from dualbrain.errors import DualbrainError

GENESIS = hashlib.sha256(b"dualbrain ledger, schema 1").hexdigest()
"""The predecessor hash of the first event; the same for all schema versions, so that a migration keeps the chain."""

RESTORE_LEDGER = (
    "Restore a copy, or move the file away and begin with an empty memory by `dualbrain memory verify --accept REASON`."
)
"""Remedy for a ledger whose events are damaged."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LedgerEvent:
    """One row of the ledger.

    `time` [s since 1970 UTC] is the time of writing, `run` the run that wrote the event and `subject` the episode that
    it concerns ("" if none). `payload` is JSON in UTF-8 with sorted keys. `hash` is SHA-256 over all other fields.
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
    """Number (0 in an empty ledger) and hash of the newest event. A copy kept elsewhere anchors the chain."""

    seq: int
    hash: str


@dataclass(frozen=True, slots=True)
class ChainReport:
    """Result of a check of the chain: the number of valid events, and number and fault of the first invalid event."""

    events: int
    head: Head
    broken_at: int | None = None
    fault: str = ""

    @property
    def is_intact(self) -> bool:
        """Whether every event is valid."""
        return self.broken_at is None


class CorruptLedgerError(DualbrainError):
    """The ledger file is damaged: an event was changed or removed, or cannot be read."""

    def __init__(self, fault: str, *, seq: int | None, path: str, fix: str = RESTORE_LEDGER) -> None:
        """Report the fault, the number of the event, the remedy `fix` and, last, the path of the file."""
        self.fault, self.seq, self.path = fault, seq, path
        where = "" if seq is None else f" at event {seq}"
        super().__init__(f"The memory ledger is damaged{where}: {fault}. Nothing was changed. {fix} {path}")


def event_digest(event: LedgerEvent) -> str:
    """SHA-256 over all fields but `hash`, each preceded by its length, so that different events never share bytes."""
    texts = (event.kind, event.run, event.subject, event.previous)
    numbers = struct.pack("<qd", event.seq, event.time)
    fields = [numbers, *(text.encode("utf-8", "surrogateescape") for text in texts), event.payload]
    framed = (part for field in fields for part in (struct.pack("<q", len(field)), field))
    return hashlib.sha256(b"".join(framed)).hexdigest()


def find_link_fault(event: LedgerEvent, before: Head) -> str:
    """The reason why `event` cannot follow `before`; "" if it can."""
    if event.seq != before.seq + 1:
        return f"event {before.seq + 1} is missing; the next event in the file is {event.seq}"
    if event.previous != before.hash:
        return "it does not name the previous event as its predecessor"
    return "" if event_digest(event) == event.hash else "its content does not match its hash"


def verified_events(events: Iterable[LedgerEvent], path: str, *, after: Head | None = None) -> Iterator[LedgerEvent]:
    """The same events, each after a check of its link; raises `CorruptLedgerError` at the first broken link.

    The first event must follow the event `after` (default: it must be the first of the chain).
    """
    head = after or Head(0, GENESIS)
    for event in events:
        if fault := find_link_fault(event, head):
            raise CorruptLedgerError(fault, seq=head.seq + 1, path=path)
        head = Head(event.seq, event.hash)
        yield event


def verify_chain(events: Iterable[LedgerEvent], anchor: Head | None = None) -> ChainReport:
    """Check every link, and that the chain contains the event `anchor`.

    Promise: a change, insertion or removal of any event before the newest is found and its number reported. Removing
    the newest events leaves a shorter, valid chain, which only an `anchor` kept elsewhere can reveal. An attacker who
    can rewrite the file and all anchors can forge a chain: the chain is evidence, not a signature.
    """
    head = Head(0, GENESIS)
    try:
        for event in events:
            fault = find_link_fault(event, head)
            if not fault and anchor is not None and event.seq == anchor.seq and event.hash != anchor.hash:
                fault = "it is not the event that the anchor names"
            if fault:
                return ChainReport(head.seq, head, head.seq + 1, fault)
            head = Head(event.seq, event.hash)
    except DualbrainError as error:
        return ChainReport(head.seq, head, head.seq + 1, f"it cannot be read: {error}")
    if anchor is not None and anchor.seq > head.seq:
        missing = f"the ledger ends at event {head.seq}, but event {anchor.seq} had been written"
        return ChainReport(head.seq, head, head.seq + 1, missing)
    return ChainReport(head.seq, head)
