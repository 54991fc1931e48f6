"""Proportions with their intervals, and Markdown tables."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from math import sqrt

Z = 1.959964
"""Standard normal quantile of a two-sided 95 % interval."""


def wilson_interval(successes: int, n: int) -> tuple[float, float]:
    """The Wilson score interval (95 %) of a proportion; (0, 1) without trials."""
    if n == 0:
        return 0.0, 1.0
    share, scale = successes / n, 1.0 + Z * Z / n
    middle = (share + Z * Z / (2 * n)) / scale
    half = Z / scale * sqrt(share * (1 - share) / n + Z * Z / (4 * n * n))
    return max(0.0, middle - half), min(1.0, middle + half)


def format_proportion(successes: int, n: int) -> str:
    """A proportion with its Wilson interval (95 %), for example 57 of 60 (86%–98%)."""
    low, high = wilson_interval(successes, n)
    return f"{successes} of {n} ({low:.0%}–{high:.0%})" if n else "none yet"


def markdown_table(head: Sequence[str], rows: Iterable[Sequence[object]]) -> list[str]:
    """A Markdown table as lines."""
    lines = [head, ["---"] * len(head), *rows]
    return ["| " + " | ".join(str(cell).replace("|", "/") for cell in line) + " |" for line in lines] + [""]
