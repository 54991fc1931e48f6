"""Selection of example episodes: failures and unsafe successes that cover many classes, scenes and methods."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

from dualbrain.evaluation.analysis.failure_taxonomy import FAILURE_CLASSES, failure_class_of
from dualbrain.evaluation.results.episode_row import EpisodeRow


def select_examples(rows: Sequence[EpisodeRow], count: int) -> list[EpisodeRow]:
    """Up to `count` episodes in which something moved and went wrong, spread over classes, then scenes, then methods.

    Among equals the most severe come first. An episode that several methods share counts once.
    """
    wrong = [row for row in rows if (failure_class_of(row) or row.violations) and row.trace_t]
    episodes = {row.same_as or row.key: row for row in reversed(wrong)}
    left = sorted(episodes.values(), key=lambda row: -row.severity)
    chosen: list[EpisodeRow] = []
    while left and len(chosen) < count:
        row = min(left, key=partial(_selection_counts, chosen))
        chosen.append(row)
        left.remove(row)
    return chosen


def _selection_counts(chosen: Sequence[EpisodeRow], row: EpisodeRow) -> tuple[int, ...]:
    """How often the class, the scene and the method of `row` were chosen already, and the rank of its class."""
    return (
        sum(failure_class_of(one) == failure_class_of(row) for one in chosen),
        sum((one.task, one.seed) == (row.task, row.seed) for one in chosen),
        sum(one.method == row.method for one in chosen),
        _class_rank(row),
    )


def _class_rank(row: EpisodeRow) -> int:
    name = failure_class_of(row)
    return FAILURE_CLASSES.index(name) if name else len(FAILURE_CLASSES)
