"""The events in effect: a rollback is an event, after which the history branches off an earlier event.

Events form a tree. The parent of event s is s − 1; the parent of a rollback to T is T. The events in effect at s are
those on the path from the root to s. No rollback is final: a rollback to an event before an earlier rollback restores
the events that the earlier one had hidden.
"""

from __future__ import annotations

from collections.abc import Mapping

from dualbrain.errors import ConfigurationError


def effective_ranges(rollbacks: Mapping[int, int], head: int) -> tuple[range, ...]:
    """The numbers of the events in effect at event `head`, oldest first, as ranges.

    `rollbacks` maps the number of each rollback event to the event whose state it restored.
    """
    ranges: list[range] = []
    branches = sorted(seq for seq in rollbacks if seq <= head)
    end = head
    while end > 0:
        while branches and branches[-1] > end:
            branches.pop()
        start = branches[-1] if branches else 1
        ranges.append(range(start, end + 1))
        end = rollbacks[start] if branches else 0
    return tuple(reversed(ranges))


def check_rollback_target(target: int, head: int) -> None:
    """Raise `ConfigurationError` unless `target` is the number of an event up to `head`, the newest, or 0."""
    if not 0 <= target <= head:
        raise ConfigurationError("rollback target", got=target, allowed=f"an event number from 0 to {head}")
