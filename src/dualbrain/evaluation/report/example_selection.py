"""Which flights are shown: failures and unsafe successes, as many classes, scenes and methods as there is room for."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

from dualbrain.evaluation.analysis.failure_taxonomy import FAILURE_CLASSES, failure_class_of
from dualbrain.evaluation.results.episode_row import EpisodeRow


def select_examples(rows: Sequence[EpisodeRow], count: int) -> list[EpisodeRow]:
    """Up to `count` flights in which something moved and went wrong: classes in turn, then scenes, then methods.

    Among equals the most severe come first. What several methods share is one flight.
    """
    wrong = [row for row in rows if (failure_class_of(row) or row.violations) and row.trace_t]
    flights = {row.same_as or row.key: row for row in reversed(wrong)}
    left = sorted(flights.values(), key=lambda row: -row.severity)
    found: list[EpisodeRow] = []
    while left and len(found) < count:
        row = min(left, key=partial(_selection_counts, found))
        found.append(row)
        left.remove(row)
    return found


def _selection_counts(found: Sequence[EpisodeRow], row: EpisodeRow) -> tuple[int, ...]:
    """How often class, scene and method of `row` were found, and where its class stands."""
    return (
        sum(failure_class_of(one) == failure_class_of(row) for one in found),
        sum((one.task, one.seed) == (row.task, row.seed) for one in found),
        sum(one.method == row.method for one in found),
        _class_rank(row),
    )


def _class_rank(row: EpisodeRow) -> int:
    found = failure_class_of(row)
    return FAILURE_CLASSES.index(found) if found else len(FAILURE_CLASSES)
