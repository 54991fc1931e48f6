"""The robot's own verdicts compared with ground truth; memory learns from the former and never sees the latter."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace

from experiments.engine.experiment import Row
from experiments.figures.tables import format_proportion, markdown_table

EXECUTED_OUTCOMES = ("succeeded", "failed", "taken_over", "stopped")
"""Outcomes of executed contracts; without motion there is no verdict to compare."""


@dataclass(frozen=True, slots=True, kw_only=True)
class VerdictConfusion:
    """Number of episodes by the robot's verdict (r = 1 or 0) and by ground truth.

    `disputed` and `true_disputed` count the false and the true reports of success that the outcome check disputed;
    memory ignores both. They are None if no outcome check was recorded.
    """

    true_claims: int
    false_claims: int
    missed: int
    true_failures: int
    disputed: int | None = None
    true_disputed: int | None = None


def count_verdicts(rows: list[Row]) -> VerdictConfusion:
    """Count `rows` in which a contract was executed and both verdicts are known."""
    both = [row for row in rows if row.get("outcome") in EXECUTED_OUTCOMES and "truth" in row]
    pairs = Counter((row["outcome"] == "succeeded", bool(row["truth"])) for row in both)
    counts = VerdictConfusion(
        true_claims=pairs[True, True],
        false_claims=pairs[True, False],
        missed=pairs[False, True],
        true_failures=pairs[False, False],
    )
    if not any("second_opinion" in row for row in both):
        return counts
    claims = [row for row in both if row["outcome"] == "succeeded" and row.get("second_opinion") == "disagrees"]
    right = sum(bool(row["truth"]) for row in claims)
    return replace(counts, disputed=len(claims) - right, true_disputed=right)


def confusion_table(rows: list[Row]) -> list[str]:
    """The confusion matrix and its rates in Markdown; empty if no contract was executed."""
    c = count_verdicts(rows)
    claims, failures = c.true_claims + c.false_claims, c.missed + c.true_failures
    if not claims + failures:
        return []
    head = ("robot ↓, ground truth →", "success", "no success")
    lines = markdown_table(
        head, (("success", c.true_claims, c.false_claims), ("no success", c.missed, c.true_failures))
    )
    lines.append(
        f"Reports of success that are true: {format_proportion(c.true_claims, claims)}; reports of failure that are "
        f"true: {format_proportion(c.true_failures, failures)}."
    )
    if c.disputed is not None:
        lines.append(
            f"The outcome check disputes {format_proportion(c.disputed, c.false_claims)} of the false reports of "
            f"success and {format_proportion(c.true_disputed or 0, c.true_claims)} of the true ones."
        )
    return [*lines, ""]
