"""Exact compaction: a new, short ledger with the same memories, weights and statuses; the long one stays as archive."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import msgspec

from dualbrain.errors import InvalidSetup
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
    Compacted,
    Folded,
    Neighbourhood,
    Status,
    StatusChange,
    Weighing,
)
from dualbrain.memory.ledger.hash_chain import Event, checked
from dualbrain.memory.ledger.ledger import Entry, Ledger, LedgerReader
from dualbrain.memory.plasticity.affine_map import UNCHANGED, Factors
from dualbrain.memory.state.derivation import derive, effective
from dualbrain.memory.state.episode_record import read_memo
from dualbrain.memory.state.state import State

AT_ONCE = 500
"""Events in one transaction."""
STATUS_KIND: dict[Status, str] = {"active": RELEASE, "quarantined": QUARANTINE, "forgotten": TOMBSTONE}


def compact(source: LedgerReader, target: Path, *, holder: str, now: float) -> State:
    """Write into `target` what `source` holds now; returns the state, which both then have, to the bit.

    Kept: every episode in effect with its vector, adapters' use, statuses. Folded: all weight events of a memory become
    one clipped affine map and the exact weight. Given up: rolling back to, and leaving out single outcomes from before
    the compaction; for that the archive is there, which the first event names by its head.
    Raises `DamagedLedger` if a link of `source` is broken, `InvalidSetup` if `target` exists.
    """
    if target.exists():
        raise InvalidSetup("compacted ledger", got="a file that exists", allowed="a new file", fix=str(target))
    for _ in checked(source.events(), str(source.path)):
        pass
    state, head = derive(source), source.head()
    with Ledger(target, holder=holder, now=now) as ledger:
        ledger.append([Entry(COMPACTED, "", Compacted(head.seq, head.hash, source.path.name))], now=now)
        for batch in _batches(_episodes(source)):
            for time, entries in batch:
                ledger.append(entries, now=time)
        ledger.append([*_folds(source, state), *_statuses(source, state), *_adapters(source)], now=now)
    return state


def swap(path: Path, *, holder: str, now: float, patience: float) -> Path:
    """Compact the ledger at `path` in place; returns where the long one lies from now on.

    A process killed on the way leaves the long ledger in force, or beside the short one under its archive name.
    """
    with Ledger(path, holder=holder, now=now, patience=patience) as long:
        archive = path.with_name(f"{path.name}.archive-{long.head().seq}")
        partial = path.with_name(f"{path.name}.compacting")
        for old in path.parent.glob(f"{partial.name}*"):
            old.unlink()
        compact(long, partial, holder=holder, now=now)
        long.settle()
        for old in path.parent.glob(f"{path.name}.snapshot-*"):
            old.unlink()
        os.link(path, archive)
        partial.replace(path)
        for rest in (path.with_name(f"{path.name}-wal"), path.with_name(f"{path.name}-shm")):
            rest.unlink(missing_ok=True)
    partial.with_name(f"{partial.name}.lock").unlink(missing_ok=True)
    return archive


def _episodes(source: LedgerReader) -> Iterator[tuple[float, Entry]]:
    vectors = dict(source.vectors())
    for event in effective(source, (EPISODE,)):
        payload = msgspec.json.decode(event.payload)
        yield event.time, Entry(EPISODE, event.subject, payload, vectors.get(event.seq), event.run)


def _batches(episodes: Iterator[tuple[float, Entry]]) -> Iterator[list[tuple[float, list[Entry]]]]:
    """Runs of episodes with the same time, which go into one transaction."""
    batch: list[tuple[float, list[Entry]]] = []
    for time, entry in episodes:
        if batch and batch[-1][0] == time and len(batch[-1][1]) < AT_ONCE:
            batch[-1][1].append(entry)
        else:
            batch.append((time, [entry]))
    yield batch


def maps(source: LedgerReader, state: State) -> dict[str, Factors]:
    """All that happened to each memory's weight, as one clipped affine map of its first weight."""
    folded = dict.fromkeys(state.rows, UNCHANGED)
    for event in effective(source, (WEIGHT, NEIGHBOURS, FOLDED)):
        for name, factors in _steps(event, state.void):
            folded[name] = folded[name].then(factors)
    return folded


def _steps(event: Event, void: frozenset[str]) -> Iterator[tuple[str, Factors]]:
    if event.kind == WEIGHT:
        one = msgspec.json.decode(event.payload, type=Weighing)
        if one.cause not in void:
            yield one.memory, one.factors
    elif event.kind == NEIGHBOURS:
        around = msgspec.json.decode(event.payload, type=Neighbourhood)
        if around.cause not in void:
            for name, offset in zip(around.memories, around.offsets, strict=True):
                yield name, Factors(1.0, offset)
    else:
        one = msgspec.json.decode(event.payload, type=Folded)
        yield one.memory, one.factors


def _folds(source: LedgerReader, state: State) -> Iterator[Entry]:
    for name, f in maps(source, state).items():
        memo = state[name]
        counts = (memo.reinforced, memo.suppressed)
        yield Entry(FOLDED, name, Folded(name, f.gain, f.offset, f.lower, f.upper, memo.weight, *counts))


def _statuses(source: LedgerReader, state: State) -> Iterator[Entry]:
    """What makes each memory's status of that with which it was stored."""
    born = {event.subject: read_memo(event.payload).status for event in effective(source, (EPISODE,))}
    for status, kind in STATUS_KIND.items():
        names = tuple(memo.id for memo in state.memos if memo.status == status != born[memo.id])
        if names:
            yield Entry(kind, "", StatusChange(names, "as it was before the compaction", "compaction"))


def _adapters(source: LedgerReader) -> Iterator[Entry]:
    for event in effective(source, (ADAPTER,)):
        yield Entry(ADAPTER, event.subject, msgspec.json.decode(event.payload))
