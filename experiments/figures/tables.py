"""Proportions with their intervals, and Markdown tables."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from statsmodels.stats.proportion import proportion_confint

from dualbrain.core import markdown
from dualbrain.evaluation.analysis.statistics import estimate


def wilson_interval(successes: int, n: int) -> tuple[float, float]:
    """The Wilson score interval (95 %) of a proportion; (0, 1) without trials."""
    if n == 0:
        return 0.0, 1.0
    low, high = proportion_confint(successes, n, alpha=0.05, method="wilson")
    return float(low), float(high)


def format_proportion(successes: int, n: int) -> str:
    """A proportion with its Wilson interval (95 %), for example 57 of 60 (86%–98%)."""
    low, high = wilson_interval(successes, n)
    return f"{successes} of {n} ({low:.0%}–{high:.0%})" if n else "none yet"


def format_share_by_scene(hits: Sequence[tuple[str, bool]]) -> str:
    """A proportion of (scene, hit) with its interval (95 %) over scenes, for example 57 of 60 (86%–98%)."""
    if not hits:
        return "none yet"
    clusters: dict[str, list[float]] = {}
    for scene, hit in hits:
        clusters.setdefault(scene, []).append(float(hit))
    found = estimate(clusters, is_rate=True)
    return f"{sum(hit for _, hit in hits)} of {len(hits)} ({max(0.0, found.low):.0%}–{min(1.0, found.high):.0%})"


def markdown_table(head: Sequence[str], rows: Iterable[Sequence[object]]) -> list[str]:
    """A Markdown table as lines, with an empty line after it."""
    return [*markdown.markdown_table(head, rows), ""]
