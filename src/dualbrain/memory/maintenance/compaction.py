"""Exact compaction: a new, short ledger with the same memories, weights and statuses; the full one is archived."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import msgspec

from dualbrain.core.storage.atomic_files import fsync_folder
from dualbrain.errors import ConfigurationError
from dualbrain.memory.ledger.events import (
    ACCEPTED,
    ADAPTER,
    COMPACTED,
    COMPACTION_ACTOR,
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
from dualbrain.memory.ledger.hash_chain import Head, LedgerEvent, verified_events
from dualbrain.memory.ledger.ledger import Ledger, LedgerReader, PendingEvent
from dualbrain.memory.ledger.shared.replicated_store import require_local
from dualbrain.memory.plasticity.affine_map import IDENTITY, AffineMap
from dualbrain.memory.state.derivation import counted_outcomes, derive_state, effective_events
from dualbrain.memory.state.episode_record import decode_event_header
from dualbrain.memory.state.state import LedgerState

EVENTS_PER_TRANSACTION = 500
"""Largest number of events in one transaction."""
EVENT_KIND_BY_STATUS: dict[Status, str] = {"active": RELEASE, "quarantined": QUARANTINE, "forgotten": TOMBSTONE}


def compact_ledger(source: LedgerReader, target: Path, *, holder: str, now: float) -> LedgerState:
    """Write the present content of `source` into `target`; returns the state, which is the same for both, bit for bit.

    Kept: every episode in effect with its vector, adapter events, statuses. Folded: all weight events of a memory
    become one clipped affine map and the exact weight. Lost: the ability to roll back to events before the compaction,
    and to exclude single outcomes of that time; the archive, which the first event names by its head, still has both.
    The written file is read again and compared. Raises `CorruptLedgerError` if a link or a vector of `source` is wrong,
    and `ConfigurationError` if `target` exists, or does not contain everything afterwards.
    """
    if target.exists():
        raise ConfigurationError.stating(
            f"The target of the compaction, {target}, exists already.", fix="Choose a new file."
        )
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
            [
                *_folded_events(source, state),
                *_status_events(source, state),
                *_adapter_events(source),
                *_accepted_events(source),
            ],
            now=now,
        )
        ledger.checkpoint_wal()
        written = ledger.head()
    _verify_compacted(target, state, written)
    return state


def compact_in_place(path: Path, *, holder: str, now: float, timeout_s: float) -> Path:
    """Compact the ledger at `path` in place; returns the path of the archive, which is the full ledger.

    If the process is killed during the compaction, the full ledger remains at `path`, or is the archive beside the
    compacted one. Raises `ConfigurationError` for a shared ledger, if the archive exists already, and if another
    process reads the ledger; then the full ledger remains at `path`, too.
    """
    require_local(path, "compacted")
    with Ledger(path, holder=holder, now=now, timeout_s=timeout_s) as full:
        archive = path.with_name(f"{path.name}.archive-{full.head().seq}")
        if archive.exists() and not archive.samefile(path):
            sentence = f"The archive of the compaction, {archive}, exists already."
            raise ConfigurationError.stating(sentence, fix="Compact the ledger after its next event.")
        partial = path.with_name(f"{path.name}.compacting")
        for old in path.parent.glob(f"{partial.name}*"):
            old.unlink()
        compact_ledger(full, partial, holder=holder, now=now)
        full.checkpoint_wal()
        for file in (path, partial):
            _require_empty_wal(file)
        for old in path.parent.glob(f"{path.name}.snapshot-*"):
            old.unlink()
        if not archive.exists():
            os.link(path, archive)
        fsync_folder(path.parent)
        partial.replace(path)
        fsync_folder(path.parent)
        for leftover in (path.with_name(f"{path.name}-wal"), path.with_name(f"{path.name}-shm")):
            leftover.unlink(missing_ok=True)
    for suffix in (".lock", ".anchor", "-wal", "-shm"):
        partial.with_name(f"{partial.name}{suffix}").unlink(missing_ok=True)
    Ledger(path, holder=holder, now=now, timeout_s=timeout_s).close()  # writes the anchor of the compacted ledger
    return archive


def _verify_compacted(target: Path, state: LedgerState, head: Head) -> None:
    """Raise `ConfigurationError` unless the file `target` alone has the events up to `head`, and the `state`."""
    _require_empty_wal(target)
    with LedgerReader(target) as written:
        chain = written.verify()
        is_complete = chain.is_intact and chain.head == head and _learned(derive_state(written)) == _learned(state)
    if not is_complete:
        sentence = f"The compacted ledger {target} differs from the full one, which is unchanged."
        raise ConfigurationError.stating(sentence, fix="Check the disk, remove the compacted ledger, and try again.")


def _learned(state: LedgerState) -> list[tuple[object, ...]]:
    """The fields of all memories that a compaction must preserve, bit for bit."""
    return [(memo.id, memo.status, memo.weight, memo.reinforced, memo.suppressed) for memo in state.memories]


def _require_empty_wal(path: Path) -> None:
    """Raise `ConfigurationError` if some events of the ledger at `path` are only in its write-ahead log."""
    target = path.resolve()
    log = target.with_name(f"{target.name}-wal")
    if log.exists() and log.stat().st_size:
        sentence = f"The write-ahead log {log} is not empty, so that the ledger file alone is not complete."
        raise ConfigurationError.stating(sentence, fix="Close other processes that use the ledger, and try again.")


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
    """Groups of successive episodes with the same time, for one transaction each."""
    batch: list[tuple[float, list[PendingEvent]]] = []
    for time, entry in episodes:
        if batch and batch[-1][0] == time and len(batch[-1][1]) < EVENTS_PER_TRANSACTION:
            batch[-1][1].append(entry)
        else:
            batch.append((time, [entry]))
    yield batch


def compose_weight_updates(source: LedgerReader, state: LedgerState) -> dict[str, AffineMap]:
    """All updates of each memory's weight, as one clipped affine map of its initial weight."""
    folded = dict.fromkeys(state.rows, IDENTITY)
    for event in effective_events(source, (WEIGHT, NEIGHBOURS, FOLDED)):
        for name, update in _update_steps(event, state.void):
            folded[name] = folded[name].compose(update)
    return folded


def _update_steps(event: LedgerEvent, void: frozenset[str]) -> Iterator[tuple[str, AffineMap]]:
    if event.kind == WEIGHT:
        update = msgspec.json.decode(event.payload, type=WeightUpdate)
        if update.cause not in void:
            yield update.memory, update.affine_map
    elif event.kind == NEIGHBOURS:
        neighbours = msgspec.json.decode(event.payload, type=NeighbourUpdates)
        if neighbours.cause not in void:
            for name, offset in zip(neighbours.memories, neighbours.offsets, strict=True):
                yield name, AffineMap(1.0, offset)
    else:
        folded = msgspec.json.decode(event.payload, type=FoldedUpdates)
        yield folded.memory, folded.affine_map


def _folded_events(source: LedgerReader, state: LedgerState) -> Iterator[PendingEvent]:
    counted = counted_outcomes(source, void=state.void)
    for name, update in compose_weight_updates(source, state).items():
        memo = state[name]
        yield PendingEvent(
            kind=FOLDED,
            subject=name,
            payload=FoldedUpdates(
                memory=name,
                gain=update.gain,
                offset=update.offset,
                lower=update.lower,
                upper=update.upper,
                weight=memo.weight,
                reinforced=memo.reinforced,
                suppressed=memo.suppressed,
                has_own_outcome=name in counted,
            ),
        )


def _status_events(source: LedgerReader, state: LedgerState) -> Iterator[PendingEvent]:
    """Events that change the initial status of each memory to its present status."""
    initial = {
        event.subject: decode_event_header(event.payload).status for event in effective_events(source, (EPISODE,))
    }
    for status, kind in EVENT_KIND_BY_STATUS.items():
        names = tuple(memo.id for memo in state.memories if memo.status == status != initial[memo.id])
        if names:
            reason = "as it was before the compaction"
            yield PendingEvent(kind=kind, subject="", payload=StatusChange(names, reason, COMPACTION_ACTOR))


def _accepted_events(source: LedgerReader) -> Iterator[PendingEvent]:
    for event in source.events(ACCEPTED):
        yield PendingEvent(kind=ACCEPTED, subject="", payload=msgspec.json.decode(event.payload))


def _adapter_events(source: LedgerReader) -> Iterator[PendingEvent]:
    for event in effective_events(source, (ADAPTER,)):
        yield PendingEvent(kind=ADAPTER, subject=event.subject, payload=msgspec.json.decode(event.payload))
