"""What a person, an audit or a replay does to memories: set aside, bring back, forget, roll back. Nothing is erased."""

from __future__ import annotations

from collections.abc import Sequence

import msgspec

from dualbrain.errors import InvalidSetup, UnknownName
from dualbrain.memory.learning.consolidation import BY_PERSON
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
    ReplayFinding,
    Rollback,
    StatusChange,
    Uses,
)
from dualbrain.memory.ledger.ledger import Entry
from dualbrain.memory.memory import Memory
from dualbrain.memory.state.derivation import effective
from dualbrain.memory.state.history import check_target
from dualbrain.records import Use


def quarantine(memory: Memory, names: Sequence[str], reason: str, *, now: float, actor: str = BY_PERSON) -> None:
    """Set memories aside: no longer offered, and what their outcomes did to weights is undone as long as they are."""
    _known(memory, names)
    memory.append([Entry(QUARANTINE, "", StatusChange(tuple(names), _why(reason), actor))], now=now)


def release(memory: Memory, names: Sequence[str], reason: str, *, now: float, actor: str = BY_PERSON) -> None:
    """Bring quarantined memories and candidates back: offered again, their influence counts again, exactly as before.

    A memory that had never been believed now teaches what it would have taught. A forgotten one does not come back this
    way: roll back to before it was forgotten.
    """
    _known(memory, names)
    if gone := [name for name in names if memory.state[name].status == "forgotten"]:
        fix = "Roll back to before they were forgotten."
        raise InvalidSetup("memories to release", got=gone, allowed="quarantined ones and candidates", fix=fix)
    memory.append([Entry(RELEASE, "", StatusChange(tuple(names), _why(reason), actor))], now=now)
    if late := memory.consolidation().taught_late(names, now):
        memory.append(late, now=now)


def forget(memory: Memory, names: Sequence[str], reason: str, *, now: float, actor: str = BY_PERSON) -> None:
    """A tombstone: never offered again, its influence undone. The event itself stays, for the chain must hold."""
    _known(memory, names)
    memory.append([Entry(TOMBSTONE, "", StatusChange(tuple(names), _why(reason), actor))], now=now)


def roll_back(memory: Memory, target: int, reason: str, *, now: float, actor: str = BY_PERSON) -> None:
    """Make memory what it was at event `target`; rolling back to before this undoes it (see `lineage`)."""
    check_target(target, memory.ledger.head().seq)
    memory.append([Entry(ROLLBACK, "", Rollback(target, _why(reason), actor))], now=now)


def note_adapter(memory: Memory, adapter: str, dataset: str, names: Sequence[str], *, now: float) -> None:
    """Write down that `adapter` was trained on these memories, from the data set of hash `dataset`; once is enough."""
    _known(memory, names)
    use = AdapterUse(adapter, dataset, tuple(names))
    noted = (event.payload for event in effective(memory.ledger, (ADAPTER,)))
    if use not in (msgspec.json.decode(payload, type=AdapterUse) for payload in noted):
        memory.append([Entry(ADAPTER, adapter, use)], now=now)


def note_uses(memory: Memory, episode: str, uses: Sequence[Use], *, now: float) -> None:
    """Write down what became of the memories that stood in the prompt of `episode`."""
    memory.append([Entry(USED, episode, Uses(episode, tuple(uses)))], now=now)


def note_audit(memory: Memory, report: object, *, now: float) -> None:
    """Write down what an audit found."""
    memory.append([Entry(AUDIT, "", report)], now=now)


def note_replay(memory: Memory, finding: ReplayFinding, *, now: float) -> None:
    """Write down what running a memory again gave; a person decides what follows from it."""
    _known(memory, (finding.memory,))
    memory.append([Entry(REPLAYED, finding.memory, finding)], now=now)


def _known(memory: Memory, names: Sequence[str]) -> None:
    if not names:
        raise InvalidSetup("memories", got="none", allowed="at least one id", fix="See `dualbrain memory list`.")
    for name in names:
        if name not in memory.state:
            raise UnknownName("memory", name, tuple(memory.state.rows), owner="this ledger")


def _why(reason: str) -> str:
    if not reason.strip():
        raise InvalidSetup("reason", got=reason, allowed="a few words", fix="Say why with --reason.")
    return reason
