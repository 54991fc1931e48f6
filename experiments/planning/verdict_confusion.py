"""The robot's own verdict beside simulator truth: memory learns from the one and never sees the other."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

from experiments.engine.experiment import Row
from experiments.figures.tables import format_proportion, markdown_table

EXECUTED_OUTCOMES = ("succeeded", "failed", "taken_over", "stopped")
"""Outcomes of contracts that were carried out; where nothing moved there is nothing to be mistaken about."""


@dataclass(frozen=True, slots=True)
class VerdictConfusion:
    """How many episodes ended in each way: what the robot says (r = 1 or 0), and what is true.

    `disputed` and `true_disputed` count the false and the true claims of success that the second opinion disputed;
    memory sets both aside. None where no second opinion was recorded.
    """

    true_claims: int
    false_claims: int
    missed: int
    true_failures: int
    disputed: int | None = None
    true_disputed: int | None = None


def count_verdicts(rows: list[Row]) -> VerdictConfusion:
    """Count `rows` in which a contract was carried out and both verdicts are known."""
    both = [row for row in rows if row.get("outcome") in EXECUTED_OUTCOMES and "truth" in row]
    seen = Counter((row["outcome"] == "succeeded", bool(row["truth"])) for row in both)
    counts = (seen[True, True], seen[True, False], seen[False, True], seen[False, False])
    if not any("second_opinion" in row for row in both):
        return VerdictConfusion(*counts)
    claims = [row for row in both if row["outcome"] == "succeeded" and row.get("second_opinion") == "disagrees"]
    right = sum(bool(row["truth"]) for row in claims)
    return VerdictConfusion(*counts, len(claims) - right, right)


def confusion_table(rows: list[Row]) -> list[str]:
    """The matrix as a table, and what it says, in markdown; nothing where nothing was carried out."""
    c = count_verdicts(rows)
    claims, failures = c.true_claims + c.false_claims, c.missed + c.true_failures
    if not claims + failures:
        return []
    head = ("the robot says ↓, truth →", "success", "no success")
    lines = markdown_table(
        head, (("success", c.true_claims, c.false_claims), ("no success", c.missed, c.true_failures))
    )
    lines.append(
        f"Claims of success that are true: {format_proportion(c.true_claims, claims)}; denials that are true: "
        f"{format_proportion(c.true_failures, failures)}."
    )
    if c.disputed is not None:
        lines.append(
            f"The second opinion disputes {format_proportion(c.disputed, c.false_claims)} of the false claims and "
            f"{format_proportion(c.true_disputed or 0, c.true_claims)} of the true ones."
        )
    return [*lines, ""]
