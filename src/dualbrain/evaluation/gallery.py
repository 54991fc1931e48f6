"""Which failures are shown: as many classes and methods as there is room for, first of each."""

from __future__ import annotations

from collections.abc import Sequence

from dualbrain.evaluation.failure import CLASSES
from dualbrain.evaluation.row import Row


def chosen(rows: Sequence[Row], count: int) -> list[Row]:
    """Up to `count` failures in which something moved, unsafe ones first, class by class in turn, no method twice."""
    left = [row for row in rows if row.failure and row.trace_t]
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
    return CLASSES.index(row.failure)
