"""What a person, an audit or a replay does to memories: set aside, bring back, forget, roll back. Nothing is erased."""

from __future__ import annotations

from collections.abc import Sequence

import msgspec

from dualbrain.errors import ConfigurationError, UnknownNameError
from dualbrain.memory.learning.consolidation import PERSON_ACTOR
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
from dualbrain.memory.ledger.ledger import PendingEvent
from dualbrain.memory.memory import Memory
from dualbrain.memory.state.derivation import effective_events
from dualbrain.memory.state.history import check_rollback_target
from dualbrain.records import MemoryUse


def quarantine(memory: Memory, names: Sequence[str], reason: str, *, now: float, actor: str = PERSON_ACTOR) -> None:
    """Set memories aside: no longer offered, and what their outcomes did to weights is undone as long as they are."""
    _check_known(memory, names)
    memory.append(
        [PendingEvent(kind=QUARANTINE, subject="", payload=StatusChange(tuple(names), _check_reason(reason), actor))],
        now=now,
    )


def release(memory: Memory, names: Sequence[str], reason: str, *, now: float, actor: str = PERSON_ACTOR) -> None:
    """Bring quarantined memories and candidates back: offered again, their influence counts again, exactly as before.

    A memory that had never been believed now teaches what it would have taught. A forgotten one does not come back this
    way: roll back to before it was forgotten.
    """
    _check_known(memory, names)
    if gone := [name for name in names if memory.state[name].status == "forgotten"]:
        fix = "Roll back to before they were forgotten."
        raise ConfigurationError("memories to release", got=gone, allowed="quarantined ones and candidates", fix=fix)
    memory.append(
        [PendingEvent(kind=RELEASE, subject="", payload=StatusChange(tuple(names), _check_reason(reason), actor))],
        now=now,
    )
    if late := memory.consolidation().released_updates(names, now):
        memory.append(late, now=now)


def forget(memory: Memory, names: Sequence[str], reason: str, *, now: float, actor: str = PERSON_ACTOR) -> None:
    """A tombstone: never offered again, its influence undone. The event itself stays, for the chain must hold."""
    _check_known(memory, names)
    memory.append(
        [PendingEvent(kind=TOMBSTONE, subject="", payload=StatusChange(tuple(names), _check_reason(reason), actor))],
        now=now,
    )


def roll_back(memory: Memory, target: int, reason: str, *, now: float, actor: str = PERSON_ACTOR) -> None:
    """Make memory what it was at event `target`; rolling back to before this undoes it (see `lineage`)."""
    check_rollback_target(target, memory.ledger.head().seq)
    memory.append(
        [PendingEvent(kind=ROLLBACK, subject="", payload=Rollback(target, _check_reason(reason), actor))], now=now
    )


def record_adapter(memory: Memory, adapter: str, dataset: str, names: Sequence[str], *, now: float) -> None:
    """Write down that `adapter` was trained on these memories, from the data set of hash `dataset`; once is enough."""
    _check_known(memory, names)
    use = AdapterUse(adapter, dataset, tuple(names))
    noted = (event.payload for event in effective_events(memory.ledger, (ADAPTER,)))
    if use not in (msgspec.json.decode(payload, type=AdapterUse) for payload in noted):
        memory.append([PendingEvent(kind=ADAPTER, subject=adapter, payload=use)], now=now)


def record_uses(memory: Memory, episode: str, uses: Sequence[MemoryUse], *, now: float) -> None:
    """Write down what became of the memories that stood in the prompt of `episode`."""
    memory.append([PendingEvent(kind=USED, subject=episode, payload=MemoryUses(episode, tuple(uses)))], now=now)


def record_audit(memory: Memory, report: object, *, now: float) -> None:
    """Write down what an audit found."""
    memory.append([PendingEvent(kind=AUDIT, subject="", payload=report)], now=now)


def record_replay(memory: Memory, finding: ReplayFinding, *, now: float) -> None:
    """Write down what running a memory again gave; a person decides what follows from it."""
    _check_known(memory, (finding.memory,))
    memory.append([PendingEvent(kind=REPLAYED, subject=finding.memory, payload=finding)], now=now)


def _check_known(memory: Memory, names: Sequence[str]) -> None:
    if not names:
        raise ConfigurationError("memories", got="none", allowed="at least one id", fix="See `dualbrain memory list`.")
    for name in names:
        if name not in memory.state:
            raise UnknownNameError("memory", name, tuple(memory.state.rows), owner="this ledger")


def _check_reason(reason: str) -> str:
    if not reason.strip():
        raise ConfigurationError("reason", got=reason, allowed="a few words", fix="Say why with --reason.")
    return reason
