"""The state of memory: every memory with its weight and status, derived from the events of the ledger."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable

import msgspec

from dualbrain.errors import DECODE_ERRORS
from dualbrain.memory.ledger.events import (
    EPISODE,
    FOLDED,
    NEIGHBOURS,
    STATUS_BY_EVENT_KIND,
    WEIGHT,
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
"""Length of a day, over which influence is counted [s]."""


class MemoryState(msgspec.Struct, kw_only=True):
    """One memory without its texts, which stay in the ledger: the fields that filters, audits and weights need.

    `time` [s, 1970 UTC] is the time at which it was stored, `seq` the number of its event, `w0` its initial and
    `weight` its present weight; `reinforced` and `suppressed` count the outcomes that changed the weight.
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
        """Whether the contract is to be followed, avoided, or neither."""
        return GUIDANCE_BY_OUTCOME[self.kind]

    @property
    def writer(self) -> str:
        """The robot that wrote the memory into a shared ledger; "" in a ledger of one robot."""
        return self.run.partition("/")[0] if "/" in self.run else ""

    @property
    def r(self) -> int:
        """Success label r ∈ {0, 1} (paper 5.1)."""
        return int(self.kind == "succeeded")


class Influence(msgspec.Struct):
    """Σ|Δw| that each source has caused on the newest day: over all memories besides the cause itself, and per memory.

    A change of an earlier day, for example by a robot whose clock is slow or whose episode waited for a server, counts
    on the newest day: otherwise its source could cause any change.
    """

    day: int = -1
    total: dict[str, float] = {}
    single: dict[str, dict[str, float]] = {}

    def add(self, day: int, source: str, memory: str, change: float) -> None:
        """Add a `change` |Δw| on `day` (days since 1970) or the newest day; a new day starts at zero."""
        if day > self.day:
            self.day, self.total, self.single = day, {}, {}
        self.total[source] = self.total.get(source, 0.0) + change
        by_memory = self.single.setdefault(source, {})
        by_memory[memory] = by_memory.get(memory, 0.0) + change

    def accumulated_change(self, day: int, source: str, memory: str) -> tuple[float, float]:
        """Σ|Δw| caused by `source` on `day` or the newest day: over all memories, and on `memory`."""
        if day > self.day:
            return 0.0, 0.0
        return self.total.get(source, 0.0), self.single.get(source, {}).get(memory, 0.0)


class LedgerState(msgspec.Struct, rename={"memories": "memos"}, kw_only=True):
    """All memories in the order of their events, the number of the last applied event, and the influence of the day.

    Weight updates that the memories in `void` caused are ignored.
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
        """Apply one event; returns the rows that it changed.

        Kinds of events that do not determine the state are ignored. Raises `KeyError` for an unknown memory, and one of
        `DECODE_ERRORS` for an invalid payload.
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
        header = decode_event_header(event.payload)
        episode = header.episode
        memo = MemoryState(
            id=episode.id,
            seq=event.seq,
            time=event.time,
            run=event.run,
            robot=episode.robot,
            registry=episode.registry,
            kind=episode.outcome.kind,
            Delta=episode.outcome.Delta,
            provenance=header.provenance,
            status=header.status,
            w0=header.w0,
            weight=header.w0,
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
    """The state after `events`, starting empty; raises `CorruptLedgerError` at an event that cannot be read."""
    state = LedgerState(void=frozenset(void))
    apply_events(events, path, state.apply)
    return state


def apply_events(events: Iterable[LedgerEvent], path: str, apply: Callable[[LedgerEvent], object]) -> None:
    """Call `apply` with each event; raises `CorruptLedgerError` with the number of an event that cannot be read."""
    for event in events:
        try:
            apply(event)
        except (*DECODE_ERRORS, KeyError) as error:
            raise CorruptLedgerError(f"unreadable: {error}", seq=event.seq, path=path) from error


def day_of(time: float) -> int:
    """Days since 1970 UTC."""
    return int(time // SECONDS_PER_DAY)
