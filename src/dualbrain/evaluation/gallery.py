"""Which episodes are shown: failures and unsafe successes, as many classes and methods as there is room for."""

from __future__ import annotations

from collections.abc import Sequence

from dualbrain.evaluation.failure import CLASSES
from dualbrain.evaluation.row import Row


def chosen(rows: Sequence[Row], count: int) -> list[Row]:
    """Up to `count` episodes in which something moved and went wrong, the most severe first, classes in turn."""
    left = [row for row in rows if (row.failure or row.violations) and row.trace_t]
    left.sort(key=lambda row: -row.severity)
    found: list[Row] = []
    while left and len(found) < count:
        seen = [(row.failure, row.method) for row in found]
        row = min(left, key=lambda one: (_times(seen, 0, one.failure), _times(seen, 1, one.method), _place(one)))
        found.append(row)
        left.remove(row)
    return found


def _times(seen: list[tuple[str, str]], part: int, value: str) -> int:
    return sum(pair[part] == value for pair in seen)


def _place(row: Row) -> int:
    return CLASSES.index(row.failure) if row.failure else len(CLASSES)
