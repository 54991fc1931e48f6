"""The result of an evaluation in two sentences: violations of the paper's kinds and of any kind, by filter."""

from __future__ import annotations

from collections.abc import Sequence

from dualbrain.evaluation.analysis.metrics import METRIC_BY_NAME, Metric
from dualbrain.evaluation.analysis.statistics import estimate
from dualbrain.evaluation.protocol.method import METHODS
from dualbrain.evaluation.report.tables import format_estimate, methods_of, values_by_cluster
from dualbrain.evaluation.results.episode_row import EpisodeRow

VIOLATION_RATE, ANY_VIOLATION = METRIC_BY_NAME["violation rate"], METRIC_BY_NAME["any violation"]


def summary_sentence(rows: Sequence[EpisodeRow]) -> str:
    """Both sentences; the intervals are over clusters, and every method counts with all its episodes."""
    guarded = [row for row in rows if METHODS[row.method].guard]
    unguarded = [row for row in rows if not METHODS[row.method].guard]
    sides = [(lead, some) for lead, some in (("with the safety filter", guarded), ("without it", unguarded)) if some]
    if not sides:
        return "No episode was run."
    if not guarded:
        sides = [("without the safety filter", unguarded)]
    parts = [f"{lead} ({', '.join(methods_of(some))}) {_unsafe_episodes(some)}" for lead, some in sides]
    others = [f"{lead} {_rate(some, ANY_VIOLATION)}" for lead, some in sides]
    first = "; ".join(parts)
    return (
        f"{first[0].upper()}{first[1:]}. Violations of any kind, also force on fragile objects, tool speed, and "
        f"objects that were dropped or moved: {', '.join(others)} of the episodes."
    )


def describe_methods(rows: Sequence[EpisodeRow]) -> str:
    """The methods that ran, each with its description."""
    return f"{'; '.join(f'{name}: {METHODS[name].description}' for name in methods_of(rows))}."


def _unsafe_episodes(rows: Sequence[EpisodeRow]) -> str:
    """Number, rate and interval of the episodes with a violation of the paper's kinds."""
    values = values_by_cluster(rows, VIOLATION_RATE)
    count = round(sum(map(sum, values.values())))
    return (
        f"{count} of {sum(map(len, values.values()))} episodes had a collision, an exceeded joint limit or an "
        f"unauthorised call ({_rate(rows, VIOLATION_RATE)})"
    )


def _rate(rows: Sequence[EpisodeRow], metric: Metric) -> str:
    """The rate of `metric` with its interval."""
    return format_estimate(estimate(values_by_cluster(rows, metric), is_rate=True), metric.unit)
