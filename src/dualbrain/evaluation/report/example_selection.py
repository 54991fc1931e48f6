"""Which flights are shown: failures and unsafe successes, as many classes, scenes and methods as there is room for."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

from dualbrain.evaluation.analysis.failure_taxonomy import CLASSES, class_of
from dualbrain.evaluation.results.episode_row import Row


def chosen(rows: Sequence[Row], count: int) -> list[Row]:
    """Up to `count` flights in which something moved and went wrong: classes in turn, then scenes, then methods.

    Among equals the most severe come first. What several methods share is one flight.
    """
    wrong = [row for row in rows if (class_of(row) or row.violations) and row.trace_t]
    flights = {row.same_as or row.key: row for row in reversed(wrong)}
    left = sorted(flights.values(), key=lambda row: -row.severity)
    found: list[Row] = []
    while left and len(found) < count:
        row = min(left, key=partial(_seen_before, found))
        found.append(row)
        left.remove(row)
    return found


def _seen_before(found: Sequence[Row], row: Row) -> tuple[int, ...]:
    """How often class, scene and method of `row` were found, and where its class stands."""
    return (
        sum(class_of(one) == class_of(row) for one in found),
        sum((one.task, one.seed) == (row.task, row.seed) for one in found),
        sum(one.method == row.method for one in found),
        _place(row),
    )


def _place(row: Row) -> int:
    found = class_of(row)
    return CLASSES.index(found) if found else len(CLASSES)
