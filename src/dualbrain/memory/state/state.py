"""What the events add up to: every memory with its weight and status. Derived, never stored as truth."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable

import msgspec

from dualbrain.errors import DECODE_ERRORS
from dualbrain.memory.ledger.events import (
    COMPACTED,
    EPISODE,
    FOLDED,
    NEIGHBOURS,
    STATUS_BY_EVENT_KIND,
    WEIGHT,
    CompactionRecord,
    FoldedUpdates,
    NeighbourUpdates,
    Status,
    StatusChange,
    WeightUpdate,
)
from dualbrain.memory.ledger.hash_chain import CorruptLedgerError, LedgerEvent
from dualbrain.memory.state.episode_record import GUIDANCE_BY_OUTCOME, Guidance, decode_event_header
from dualbrain.memory.state.provenance import Provenance
from dualbrain.records import OutcomeClass

SECONDS_PER_DAY = 86400.0
"""Influence is counted per day [s]."""


class MemoryState(msgspec.Struct, kw_only=True):
    """One memory without its texts: what filters, audits and weights need. Everything else stays in the ledger.

    `time` [s, 1970 UTC] is when it was stored, `seq` the number of its event, `w0` its first and `weight` its present
    weight; `reinforced` and `suppressed` count the outcomes that moved it.
    """

    id: str
    seq: int
    time: float
    run: str
    robot: str
    registry: str
    kind: OutcomeClass
    Delta: float | None
    provenance: Provenance
    status: Status
    w0: float
    weight: float
    reinforced: int = 0
    suppressed: int = 0

    @property
    def guidance(self) -> Guidance:
        """Whether its contract is to be followed, avoided, or neither."""
        return GUIDANCE_BY_OUTCOME[self.kind]

    @property
    def r(self) -> int:
        """Success label r ∈ {0, 1} (paper 5.1)."""
        return int(self.kind == "succeeded")


class Influence(msgspec.Struct):
    """How far each source has moved weights today: Σ|Δw| over all memories but its own, and per memory."""

    day: int = -1
    total: dict[str, float] = {}
    single: dict[str, dict[str, float]] = {}

    def add(self, day: int, source: str, memory: str, moved: float) -> None:
        """Count a move made on `day` (days since 1970); a new day begins at zero."""
        if day > self.day:
            self.day, self.total, self.single = day, {}, {}
        if day == self.day:
            self.total[source] = self.total.get(source, 0.0) + moved
            one = self.single.setdefault(source, {})
            one[memory] = one.get(memory, 0.0) + moved

    def accumulated_change(self, day: int, source: str, memory: str) -> tuple[float, float]:
        """Σ|Δw| by `source` on `day`: over all memories, and on `memory`."""
        if day != self.day:
            return 0.0, 0.0
        return self.total.get(source, 0.0), self.single.get(source, {}).get(memory, 0.0)


class LedgerState(msgspec.Struct, rename={"memories": "memos"}, kw_only=True):
    """All memories in the order of their events, the number of the last event applied, and the day's influence.

    What memories in `void` caused does not count, as if their outcomes had never been seen.
    """

    memories: list[MemoryState] = []
    seq: int = 0
    influence: Influence = msgspec.field(default_factory=Influence)
    void: frozenset[str] = frozenset()
    rows: dict[str, int] = {}

    def __getitem__(self, name: str) -> MemoryState:
        """The memory called `name`; raises `KeyError`."""
        return self.memories[self.rows[name]]

    def __contains__(self, name: object) -> bool:
        return name in self.rows

    def __len__(self) -> int:
        return len(self.memories)

    def weights(self) -> dict[str, float]:
        """Weight by id, oldest first."""
        return {memo.id: memo.weight for memo in self.memories}

    def apply(self, event: LedgerEvent) -> tuple[int, ...]:
        """Add one event; returns the rows it touched.

        Kinds that neither make a memory nor move anything are passed over. Raises `KeyError` for an unknown memory and
        what is `UNREADABLE` for a payload of another form.
        """
        self.seq = event.seq
        if event.kind == EPISODE:
            return self._add_memory(event)
        if event.kind == WEIGHT:
            return self._apply_weight_update(event)
        if event.kind == NEIGHBOURS:
            return self._apply_neighbour_updates(event)
        if event.kind == FOLDED:
            return self._apply_folded(event)
        if event.kind in STATUS_BY_EVENT_KIND:
            return self._set_status(event)
        return ()

    def _add_memory(self, event: LedgerEvent) -> tuple[int, ...]:
        head = decode_event_header(event.payload)
        told = head.episode
        memo = MemoryState(
            id=told.id,
            seq=event.seq,
            time=event.time,
            run=event.run,
            robot=told.robot,
            registry=told.registry,
            kind=told.outcome.kind,
            Delta=told.outcome.Delta,
            provenance=head.provenance,
            status=head.status,
            w0=head.w0,
            weight=head.w0,
        )
        self.rows[memo.id] = len(self.memories)
        self.memories.append(memo)
        return (len(self.memories) - 1,)

    def _apply_weight_update(self, event: LedgerEvent) -> tuple[int, ...]:
        change = msgspec.json.decode(event.payload, type=WeightUpdate)
        memo = self[change.memory]
        if change.cause in self.void:
            return ()
        up = change.rule == "reinforce"
        memo.reinforced, memo.suppressed = memo.reinforced + up, memo.suppressed + (not up)
        before, memo.weight = memo.weight, change.affine_map(memo.weight)
        if change.cause != memo.id:
            self._count_influence(event, change.cause, memo, before)
        return (self.rows[memo.id],)

    def _apply_neighbour_updates(self, event: LedgerEvent) -> tuple[int, ...]:
        change = msgspec.json.decode(event.payload, type=NeighbourUpdates)
        if change.cause in self.void:
            return ()
        for name, offset in zip(change.memories, change.offsets, strict=True):
            memo = self[name]
            before, memo.weight = memo.weight, min(1.0, max(0.0, memo.weight + offset))
            self._count_influence(event, change.cause, memo, before)
        return tuple(self.rows[name] for name in change.memories)

    def _count_influence(self, event: LedgerEvent, cause: str, memo: MemoryState, before: float) -> None:
        self.influence.add(day_of(event.time), self[cause].provenance.source, memo.id, abs(memo.weight - before))

    def _apply_folded(self, event: LedgerEvent) -> tuple[int, ...]:
        folded = msgspec.json.decode(event.payload, type=FoldedUpdates)
        memo = self[folded.memory]
        memo.weight, memo.reinforced, memo.suppressed = folded.weight, folded.reinforced, folded.suppressed
        return (self.rows[memo.id],)

    def _set_status(self, event: LedgerEvent) -> tuple[int, ...]:
        for name in msgspec.json.decode(event.payload, type=StatusChange).memories:
            self[name].status = STATUS_BY_EVENT_KIND[event.kind]
        return ()


def fold_events(events: Iterable[LedgerEvent], path: str, *, void: Collection[str] = ()) -> LedgerState:
    """The state after `events`, from nothing; raises `DamagedLedger` at one that cannot be read."""
    state = LedgerState(void=frozenset(void))
    apply_events(events, path, state.apply)
    return state


def apply_events(events: Iterable[LedgerEvent], path: str, apply: Callable[[LedgerEvent], object]) -> None:
    """Hand each event to `apply`; one that cannot be read raises `DamagedLedger` with its number."""
    for event in events:
        try:
            apply(event)
        except (*DECODE_ERRORS, KeyError) as error:
            raise CorruptLedgerError(f"unreadable: {error}", seq=event.seq, path=path) from error


def day_of(time: float) -> int:
    """Days since 1970 UTC."""
    return int(time // SECONDS_PER_DAY)


def compaction_source(event: LedgerEvent) -> CompactionRecord | None:
    """What ledger this one was made of by compaction, told by its first event."""
    return msgspec.json.decode(event.payload, type=CompactionRecord) if event.kind == COMPACTED else None
