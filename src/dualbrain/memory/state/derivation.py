"""From a ledger to the state of memory at any of its events: now, as of a time, after a rollback, as if never seen."""

from __future__ import annotations

from collections.abc import Collection, Iterator

import msgspec

from dualbrain.errors import UNREADABLE
from dualbrain.memory.ledger.events import ROLLBACK, STATUS_OF, VOID, WEIGHS, Rollback, Status, StatusChange
from dualbrain.memory.ledger.hash_chain import DamagedLedger, Event
from dualbrain.memory.ledger.ledger import LedgerReader
from dualbrain.memory.state.history import spans
from dualbrain.memory.state.state import State, fold

KINDS = (*WEIGHS, *STATUS_OF)
"""Kinds of events that make the state."""


def derive(ledger: LedgerReader, *, head: int | None = None, unseen: Collection[str] = ()) -> State:
    """The state at event `head` (default: the newest), computed from the events alone.

    What quarantined and forgotten memories did to others does not count, as long as they are. Memories in `unseen` are
    left out altogether. Law: the result equals that of a ledger in which their outcomes had moved nothing and they had
    never been stored; what the planner would have proposed without them nobody can know.
    """
    at = ledger.head().seq if head is None else head
    ranges = spans(rollbacks(ledger), at)
    void = void_at(ledger, ranges) | frozenset(unseen)
    state = fold(_events(ledger, ranges, KINDS), str(ledger.path), void=void)
    state.seq = at
    return without(state, unseen) if unseen else state


def as_of(ledger: LedgerReader, time: float) -> State:
    """The state as it was at `time` [s, 1970 UTC]."""
    return derive(ledger, head=ledger.last_before(time))


def without(state: State, names: Collection[str]) -> State:
    """The same state less some memories."""
    left = [memo for memo in state.memos if memo.id not in set(names)]
    return State(left, state.seq, state.influence, state.void, {memo.id: row for row, memo in enumerate(left)})


def rollbacks(ledger: LedgerReader) -> dict[int, int]:
    """Number of each rollback event → the event it restored."""
    found = ledger.events("kind = ?", (ROLLBACK,))
    try:
        return {event.seq: msgspec.json.decode(event.payload, type=Rollback).target for event in found}
    except UNREADABLE as error:
        raise DamagedLedger(f"a rollback is unreadable: {error}", seq=None, path=str(ledger.path)) from error


def void_at(ledger: LedgerReader, ranges: tuple[range, ...]) -> frozenset[str]:
    """Memories whose last status event in `ranges` sets them aside."""
    status: dict[str, Status] = {}
    for event in _events(ledger, ranges, tuple(STATUS_OF)):
        change = msgspec.json.decode(event.payload, type=StatusChange)
        status.update(dict.fromkeys(change.memories, STATUS_OF[event.kind]))
    return frozenset(name for name, value in status.items() if value in VOID)


def effective(ledger: LedgerReader, kinds: tuple[str, ...]) -> Iterator[Event]:
    """The events of these kinds that are in effect now, oldest first."""
    yield from _events(ledger, spans(rollbacks(ledger), ledger.head().seq), kinds)


def _events(ledger: LedgerReader, ranges: tuple[range, ...], kinds: tuple[str, ...]) -> Iterator[Event]:
    marks = ", ".join("?" * len(kinds))
    for span in ranges:
        where = f"seq BETWEEN ? AND ? AND kind IN ({marks})"
        yield from ledger.events(where, (span.start, span.stop - 1, *kinds))
