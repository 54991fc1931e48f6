"""Which events are in effect: a rollback is itself an event, after which the history branches off an earlier one.

Events form a tree. The parent of event s is s − 1; the parent of a rollback to T is T. What holds at s is the path from
the root to s. So nothing is ever undone for good: rolling back to a moment before a rollback brings back what it hid.
"""

from __future__ import annotations

from collections.abc import Mapping

from dualbrain.errors import ConfigurationError
from dualbrain.memory.ledger.hash_chain import Head
from dualbrain.memory.ledger.ledger import LedgerReader
from dualbrain.memory.state.state import compaction_source


def effective_ranges(rollbacks: Mapping[int, int], head: int) -> tuple[range, ...]:
    """The numbers of the events in effect at event `head`, oldest first, as ranges.

    `rollbacks` maps the number of each rollback event to the event whose state it restored.
    """
    found: list[range] = []
    marks = sorted(seq for seq in rollbacks if seq <= head)
    end = head
    while end > 0:
        while marks and marks[-1] > end:
            marks.pop()
        start = marks[-1] if marks else 1
        found.append(range(start, end + 1))
        end = rollbacks[start] if marks else 0
    return tuple(reversed(found))


def check_rollback_target(target: int, head: int) -> None:
    """Raise `InvalidSetup` unless an event `target` can be rolled back to when `head` is the newest."""
    if not 0 <= target <= head:
        raise ConfigurationError("rollback target", got=target, allowed=f"an event number from 0 to {head}")


def descends_from(ledger: LedgerReader, head: Head) -> bool:
    """Whether the event `head` stands in `ledger`, or in a ledger that it was compacted from and that lies beside it.

    Events are chained: who holds this one holds all before it.
    """
    if any(event.hash == head.hash for event in ledger.events("seq = ?", (head.seq,))):
        return True
    first = next(ledger.events("seq = 1"), None)
    if first is None or (longer := compaction_source(first)) is None:
        return False
    archive = ledger.path.with_name(f"{longer.archive}.archive-{longer.seq}")
    if not archive.is_file():
        return False
    with LedgerReader(archive) as opened:
        return descends_from(opened, head)
