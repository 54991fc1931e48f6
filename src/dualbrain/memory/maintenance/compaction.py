"""Exact compaction: a new, short ledger with the same memories, weights and statuses; the long one stays as archive."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import msgspec

from dualbrain.errors import ConfigurationError
from dualbrain.memory.ledger.events import (
    ADAPTER,
    COMPACTED,
    EPISODE,
    FOLDED,
    NEIGHBOURS,
    QUARANTINE,
    RELEASE,
    TOMBSTONE,
    WEIGHT,
    CompactionRecord,
    FoldedUpdates,
    NeighbourUpdates,
    Status,
    StatusChange,
    WeightUpdate,
)
from dualbrain.memory.ledger.hash_chain import LedgerEvent, verified_events
from dualbrain.memory.ledger.ledger import Ledger, LedgerReader, PendingEvent
from dualbrain.memory.plasticity.affine_map import IDENTITY, AffineMap
from dualbrain.memory.state.derivation import derive_state, effective_events
from dualbrain.memory.state.episode_record import decode_event_header
from dualbrain.memory.state.state import LedgerState

EVENTS_PER_TRANSACTION = 500
"""Events in one transaction."""
EVENT_KIND_BY_STATUS: dict[Status, str] = {"active": RELEASE, "quarantined": QUARANTINE, "forgotten": TOMBSTONE}


def compact_ledger(source: LedgerReader, target: Path, *, holder: str, now: float) -> LedgerState:
    """Write into `target` what `source` holds now; returns the state, which both then have, to the bit.

    Kept: every episode in effect with its vector, adapters' use, statuses. Folded: all weight events of a memory become
    one clipped affine map and the exact weight. Given up: rolling back to, and leaving out single outcomes from before
    the compaction; for that the archive is there, which the first event names by its head.
    Raises `DamagedLedger` if a link of `source` is broken, `InvalidSetup` if `target` exists.
    """
    if target.exists():
        raise ConfigurationError("compacted ledger", got="a file that exists", allowed="a new file", fix=str(target))
    for _ in verified_events(source.events(), str(source.path)):
        pass
    state, head = derive_state(source), source.head()
    with Ledger(target, holder=holder, now=now) as ledger:
        ledger.append(
            [PendingEvent(kind=COMPACTED, subject="", payload=CompactionRecord(head.seq, head.hash, source.path.name))],
            now=now,
        )
        for batch in _batches(_episode_events(source)):
            for time, entries in batch:
                ledger.append(entries, now=time)
        ledger.append(
            [*_folded_events(source, state), *_status_events(source, state), *_adapter_events(source)], now=now
        )
    return state


def compact_in_place(path: Path, *, holder: str, now: float, timeout_s: float) -> Path:
    """Compact the ledger at `path` in place; returns where the long one lies from now on.

    A process killed on the way leaves the long ledger in force, or beside the short one under its archive name.
    """
    with Ledger(path, holder=holder, now=now, timeout_s=timeout_s) as long:
        archive = path.with_name(f"{path.name}.archive-{long.head().seq}")
        partial = path.with_name(f"{path.name}.compacting")
        for old in path.parent.glob(f"{partial.name}*"):
            old.unlink()
        compact_ledger(long, partial, holder=holder, now=now)
        long.checkpoint_wal()
        for old in path.parent.glob(f"{path.name}.snapshot-*"):
            old.unlink()
        os.link(path, archive)
        partial.replace(path)
        for rest in (path.with_name(f"{path.name}-wal"), path.with_name(f"{path.name}-shm")):
            rest.unlink(missing_ok=True)
    partial.with_name(f"{partial.name}.lock").unlink(missing_ok=True)
    return archive


def _episode_events(source: LedgerReader) -> Iterator[tuple[float, PendingEvent]]:
    vectors = dict(source.vectors())
    for event in effective_events(source, (EPISODE,)):
        payload = msgspec.json.decode(event.payload)
        yield (
            event.time,
            PendingEvent(
                kind=EPISODE, subject=event.subject, payload=payload, vector=vectors.get(event.seq), run=event.run
            ),
        )


def _batches(episodes: Iterator[tuple[float, PendingEvent]]) -> Iterator[list[tuple[float, list[PendingEvent]]]]:
    """Runs of episodes with the same time, which go into one transaction."""
    batch: list[tuple[float, list[PendingEvent]]] = []
    for time, entry in episodes:
        if batch and batch[-1][0] == time and len(batch[-1][1]) < EVENTS_PER_TRANSACTION:
            batch[-1][1].append(entry)
        else:
            batch.append((time, [entry]))
    yield batch


def compose_weight_updates(source: LedgerReader, state: LedgerState) -> dict[str, AffineMap]:
    """All that happened to each memory's weight, as one clipped affine map of its first weight."""
    folded = dict.fromkeys(state.rows, IDENTITY)
    for event in effective_events(source, (WEIGHT, NEIGHBOURS, FOLDED)):
        for name, factors in _update_steps(event, state.void):
            folded[name] = folded[name].compose(factors)
    return folded


def _update_steps(event: LedgerEvent, void: frozenset[str]) -> Iterator[tuple[str, AffineMap]]:
    if event.kind == WEIGHT:
        one = msgspec.json.decode(event.payload, type=WeightUpdate)
        if one.cause not in void:
            yield one.memory, one.affine_map
    elif event.kind == NEIGHBOURS:
        around = msgspec.json.decode(event.payload, type=NeighbourUpdates)
        if around.cause not in void:
            for name, offset in zip(around.memories, around.offsets, strict=True):
                yield name, AffineMap(1.0, offset)
    else:
        one = msgspec.json.decode(event.payload, type=FoldedUpdates)
        yield one.memory, one.affine_map


def _folded_events(source: LedgerReader, state: LedgerState) -> Iterator[PendingEvent]:
    for name, f in compose_weight_updates(source, state).items():
        memo = state[name]
        yield PendingEvent(
            kind=FOLDED,
            subject=name,
            payload=FoldedUpdates(
                memory=name,
                gain=f.gain,
                offset=f.offset,
                lower=f.lower,
                upper=f.upper,
                weight=memo.weight,
                reinforced=memo.reinforced,
                suppressed=memo.suppressed,
            ),
        )


def _status_events(source: LedgerReader, state: LedgerState) -> Iterator[PendingEvent]:
    """What makes each memory's status of that with which it was stored."""
    born = {event.subject: decode_event_header(event.payload).status for event in effective_events(source, (EPISODE,))}
    for status, kind in EVENT_KIND_BY_STATUS.items():
        names = tuple(memo.id for memo in state.memories if memo.status == status != born[memo.id])
        if names:
            yield PendingEvent(
                kind=kind, subject="", payload=StatusChange(names, "as it was before the compaction", "compaction")
            )


def _adapter_events(source: LedgerReader) -> Iterator[PendingEvent]:
    for event in effective_events(source, (ADAPTER,)):
        yield PendingEvent(kind=ADAPTER, subject=event.subject, payload=msgspec.json.decode(event.payload))
