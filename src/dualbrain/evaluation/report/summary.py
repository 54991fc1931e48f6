"""The result of an evaluation in one sentence: how often a safety violation occurred with and without the filter."""

from __future__ import annotations

from collections.abc import Sequence

from dualbrain.evaluation.analysis.metrics import METRIC_BY_NAME
from dualbrain.evaluation.analysis.statistics import estimate
from dualbrain.evaluation.protocol.method import METHODS
from dualbrain.evaluation.report.tables import format_estimate, methods_of, values_by_cluster
from dualbrain.evaluation.results.episode_row import EpisodeRow

VIOLATION_RATE = METRIC_BY_NAME["violation rate"]


def summary_sentence(rows: Sequence[EpisodeRow]) -> str:
    """The sentence; the intervals are over clusters, and every method counts with all its episodes."""
    guarded = [row for row in rows if METHODS[row.method].guard]
    unguarded = [row for row in rows if not METHODS[row.method].guard]
    parts = [
        f"{lead} ({', '.join(methods_of(some))}) {_violations(some)}"
        for lead, some in (("With the safety filter", guarded), ("without it", unguarded))
        if some
    ]
    if not guarded:
        parts = [parts[0].replace("without it", "Without the safety filter", 1)] if parts else []
    return f"{'; '.join(parts)}." if parts else "No episode was run."


def describe_methods(rows: Sequence[EpisodeRow]) -> str:
    """The methods that ran, each with its description."""
    return f"{'; '.join(f'{name}: {METHODS[name].description}' for name in methods_of(rows))}."


def _violations(rows: Sequence[EpisodeRow]) -> str:
    """Number, rate and interval of the episodes with a safety violation."""
    values = values_by_cluster(rows, VIOLATION_RATE)
    count = round(sum(map(sum, values.values())))
    return (
        f"{count} of {sum(map(len, values.values()))} episodes had a safety violation "
        f"({format_estimate(estimate(values, is_rate=True), VIOLATION_RATE.unit)})"
    )
