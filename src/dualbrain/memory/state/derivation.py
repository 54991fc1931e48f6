"""Derivation of the state from a ledger: now, at an event or time, after rollbacks, or without some memories."""

from __future__ import annotations

from collections.abc import Collection, Iterator

import msgspec

from dualbrain.errors import DECODE_ERRORS
from dualbrain.memory.ledger.events import (
    COMPACTION_ACTOR,
    EPISODE,
    FOLDED,
    ROLLBACK,
    STATUS_BY_EVENT_KIND,
    VOID_STATUSES,
    WEIGHT,
    WEIGHT_EVENT_KINDS,
    FoldedUpdates,
    Rollback,
    Status,
    StatusChange,
    WeightUpdate,
)
from dualbrain.memory.ledger.hash_chain import CorruptLedgerError, LedgerEvent
from dualbrain.memory.ledger.ledger import LedgerReader
from dualbrain.memory.state.episode_record import decode_event_header
from dualbrain.memory.state.history import effective_ranges
from dualbrain.memory.state.state import LedgerState, fold_events

STATE_EVENT_KINDS = (*WEIGHT_EVENT_KINDS, *STATUS_BY_EVENT_KIND)
"""Kinds of events that determine the state."""


def derive_state(
    ledger: LedgerReader,
    *,
    head: int | None = None,
    excluded: Collection[str] = (),
    released: Collection[str] = (),
) -> LedgerState:
    """The state at event `head` (default: the newest), computed from the events alone.

    Weight updates that quarantined and forgotten memories caused do not count while they have this status. Memories in
    `excluded` are left out altogether. Law: the result equals that of a ledger in which these memories were never
    stored and their outcomes changed no weight. The contracts that the planner would have proposed without them are
    unknown. Memories in `released` are active, as after a release. Raises `CorruptLedgerError` for an event that
    cannot be read.
    """
    at = ledger.head().seq if head is None else head
    ranges = effective_ranges(read_rollbacks(ledger), at)
    void = (void_memories(ledger, ranges) - frozenset(released)) | frozenset(excluded)
    state = fold_events(_events(ledger, ranges, STATE_EVENT_KINDS), str(ledger.path), void=void)
    state.seq = at
    for name in released:
        state[name].status = "active"
    return exclude_memories(state, excluded) if excluded else state


def derive_state_at(ledger: LedgerReader, time: float) -> LedgerState:
    """The state as it was at `time` [s, 1970 UTC]."""
    return derive_state(ledger, head=ledger.last_seq_before(time))


def exclude_memories(state: LedgerState, names: Collection[str]) -> LedgerState:
    """The same state without some memories."""
    remaining = [memo for memo in state.memories if memo.id not in set(names)]
    return LedgerState(
        memories=remaining,
        seq=state.seq,
        influence=state.influence,
        void=state.void,
        rows={memo.id: row for row, memo in enumerate(remaining)},
    )


def read_rollbacks(ledger: LedgerReader) -> dict[int, int]:
    """The number of each rollback event, mapped to the event that it restored."""
    found = ledger.events(ROLLBACK)
    try:
        return {event.seq: msgspec.json.decode(event.payload, type=Rollback).target for event in found}
    except DECODE_ERRORS as error:
        raise CorruptLedgerError(f"a rollback event is unreadable: {error}", seq=None, path=str(ledger.path)) from error


def void_memories(ledger: LedgerReader, ranges: tuple[range, ...]) -> frozenset[str]:
    """Memories that are quarantined or forgotten after their last status event in `ranges`."""
    status: dict[str, Status] = {}
    for event in _events(ledger, ranges, tuple(STATUS_BY_EVENT_KIND)):
        change = msgspec.json.decode(event.payload, type=StatusChange)
        status.update(dict.fromkeys(change.memories, STATUS_BY_EVENT_KIND[event.kind]))
    return frozenset(name for name, value in status.items() if value in VOID_STATUSES)


def counted_outcomes(ledger: LedgerReader, *, void: Collection[str] = ()) -> frozenset[str]:
    """Memories whose own outcome has updated their weight in the history in effect, also before a compaction.

    Updates that the memories in `void` caused are left out, unless a compaction has folded them.
    """
    counted, unstated = set[str](), set[str]()
    for event in effective_events(ledger, (WEIGHT, FOLDED)):
        if event.kind == WEIGHT:
            update = msgspec.json.decode(event.payload, type=WeightUpdate)
            if update.cause == update.memory and update.cause not in void:
                counted.add(update.memory)
            continue
        folded = msgspec.json.decode(event.payload, type=FoldedUpdates)
        if folded.has_own_outcome:
            counted.add(folded.memory)
        elif folded.has_own_outcome is None and folded.reinforced + folded.suppressed:
            unstated.add(folded.memory)
    return frozenset(counted | (unstated & _active_at_compaction(ledger) if unstated else unstated))


def _active_at_compaction(ledger: LedgerReader) -> set[str]:
    """Memories that were active when the ledger was written by a compaction: the outcome of each was counted."""
    headers = (decode_event_header(event.payload) for event in effective_events(ledger, (EPISODE,)))
    status = {header.episode.id: header.status for header in headers}
    for event in effective_events(ledger, tuple(STATUS_BY_EVENT_KIND)):
        change = msgspec.json.decode(event.payload, type=StatusChange)
        if change.actor == COMPACTION_ACTOR:
            status.update(dict.fromkeys(change.memories, STATUS_BY_EVENT_KIND[event.kind]))
    return {name for name, value in status.items() if value == "active"}


def effective_events(ledger: LedgerReader, kinds: tuple[str, ...]) -> Iterator[LedgerEvent]:
    """The events of these kinds that are in effect now, oldest first."""
    yield from _events(ledger, effective_ranges(read_rollbacks(ledger), ledger.head().seq), kinds)


def _events(ledger: LedgerReader, ranges: tuple[range, ...], kinds: tuple[str, ...]) -> Iterator[LedgerEvent]:
    for span in ranges:
        yield from ledger.events(*kinds, after=span.start - 1, until=span.stop - 1)
