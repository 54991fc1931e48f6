"""Edits by a person, an audit or a replay: quarantine, release, forget and roll back. No event is ever erased."""

from __future__ import annotations

from collections.abc import Sequence

import msgspec

from dualbrain.errors import ConfigurationError, UnknownNameError
from dualbrain.memory.learning.consolidation import PERSON_ACTOR, Consolidation
from dualbrain.memory.ledger.events import (
    ADAPTER,
    AUDIT,
    QUARANTINE,
    RELEASE,
    REPLAYED,
    ROLLBACK,
    TOMBSTONE,
    USED,
    AdapterUse,
    MemoryUses,
    ReplayFinding,
    Rollback,
    StatusChange,
)
from dualbrain.memory.ledger.ledger import Ledger, PendingEvent
from dualbrain.memory.memory import Memory
from dualbrain.memory.state.derivation import derive_state, effective_events
from dualbrain.memory.state.history import check_rollback_target
from dualbrain.records import MemoryUse


def quarantine(memory: Memory, names: Sequence[str], reason: str, *, now: float, actor: str = PERSON_ACTOR) -> None:
    """Quarantine memories: they are not retrieved, and the weight updates of their outcomes are undone until a release.

    Raises `ConfigurationError` without an id or a reason, and `UnknownNameError` for an id that is not in the ledger.
    """
    _check_known(memory, names)
    memory.append(
        [PendingEvent(kind=QUARANTINE, subject="", payload=StatusChange(tuple(names), _check_reason(reason), actor))],
        now=now,
    )


def release(memory: Memory, names: Sequence[str], reason: str, *, now: float, actor: str = PERSON_ACTOR) -> None:
    """Release quarantined memories and candidates: they are retrieved again, and their weight updates count again.

    A memory that was never active before now causes the weight updates of its outcome, in the same transaction. A
    forgotten memory cannot be released: roll back to an event before it was forgotten. Raises `ConfigurationError` and
    `UnknownNameError`.
    """
    change = StatusChange(tuple(names), _check_reason(reason), actor)

    def compute() -> list[PendingEvent]:
        _check_known(memory, names)
        if forgotten := [name for name in names if memory.state[name].status == "forgotten"]:
            raise ConfigurationError.stating(
                f"Forgotten memories cannot be released: {', '.join(forgotten)}.",
                fix="Roll back to an event before they were forgotten.",
            )
        return [PendingEvent(kind=RELEASE, subject="", payload=change), *_released_updates(memory, names, now)]

    memory.append_computed(compute, now=now)


def forget(memory: Memory, names: Sequence[str], reason: str, *, now: float, actor: str = PERSON_ACTOR) -> None:
    """Forget memories: they are never retrieved again, and their weight updates are undone.

    The events stay in the ledger, because the hash chain must stay valid. Raises `ConfigurationError` and
    `UnknownNameError`.
    """
    _check_known(memory, names)
    memory.append(
        [PendingEvent(kind=TOMBSTONE, subject="", payload=StatusChange(tuple(names), _check_reason(reason), actor))],
        now=now,
    )


def roll_back(memory: Memory, target: int, reason: str, *, now: float, actor: str = PERSON_ACTOR) -> None:
    """Restore the state of memory at event `target`.

    A later rollback to an event before this rollback undoes it (see `memory.state.history`). Raises
    `ConfigurationError` if there is no such event.
    """
    check_rollback_target(target, memory.ledger.head().seq)
    memory.append(
        [PendingEvent(kind=ROLLBACK, subject="", payload=Rollback(target, _check_reason(reason), actor))], now=now
    )


def record_adapter(memory: Memory, adapter: str, dataset: str, names: Sequence[str], *, now: float) -> None:
    """Record, once, that `adapter` was trained on these memories from the data set with the hash `dataset`."""
    _check_known(memory, names)
    use = AdapterUse(adapter, dataset, tuple(names))
    recorded = (event.payload for event in effective_events(memory.ledger, (ADAPTER,)))
    if use not in (msgspec.json.decode(payload, type=AdapterUse) for payload in recorded):
        memory.append([PendingEvent(kind=ADAPTER, subject=adapter, payload=use)], now=now)


def record_uses(ledger: Ledger, episode: str, uses: Sequence[MemoryUse], *, now: float) -> None:
    """Record the use of the memories that were in the prompt of `episode`."""
    name = ledger.qualify(episode)
    ledger.record([PendingEvent(kind=USED, subject=name, payload=MemoryUses(name, tuple(uses)))], now=now)


def record_audit(memory: Memory, report: object, *, now: float) -> None:
    """Record the result of an audit."""
    memory.append([PendingEvent(kind=AUDIT, subject="", payload=report)], now=now)


def record_replay(memory: Memory, finding: ReplayFinding, *, now: float) -> None:
    """Record the result of a replay of a memory; a person decides on the consequences."""
    _check_known(memory, (finding.memory,))
    memory.append([PendingEvent(kind=REPLAYED, subject=finding.memory, payload=finding)], now=now)


def _released_updates(memory: Memory, names: Sequence[str], now: float) -> list[PendingEvent]:
    """The weight events that a release of `names` causes, computed from the state after it.

    Active memories cause none: their outcomes have been counted when they became active.
    """
    released = [name for name in dict.fromkeys(names) if memory.state[name].status != "active"]
    if not released:
        return []
    state, rows = derive_state(memory.ledger, released=released), [memory.state.rows[name] for name in released]
    memory.index.sync(state, rows)
    try:
        return Consolidation(memory.ledger, state, memory.index, memory.config).released_updates(released, now)
    finally:
        memory.index.sync(memory.state, rows)


def _check_known(memory: Memory, names: Sequence[str]) -> None:
    if not names:
        raise ConfigurationError.stating("No memory was named.", fix="List the ids with `dualbrain memory list`.")
    for name in names:
        if name not in memory.state:
            raise UnknownNameError("memory", name, tuple(memory.state.rows), owner="this ledger")


def _check_reason(reason: str) -> str:
    if not reason.strip():
        raise ConfigurationError.stating("The reason is empty.", fix="State a reason with --reason.")
    return reason
