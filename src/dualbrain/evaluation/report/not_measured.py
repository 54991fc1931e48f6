"""What was not measured, said openly: metrics without a value, methods and hypotheses that were not flown."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence

from dualbrain.evaluation.analysis.hypotheses import answers
from dualbrain.evaluation.analysis.metrics import MAIN, METRICS
from dualbrain.evaluation.protocol.method import MAIN as MAIN_METHODS
from dualbrain.evaluation.protocol.suite import Suite
from dualbrain.evaluation.report.adaptation_cost import Cost
from dualbrain.evaluation.results.episode_row import Row
from dualbrain.simulation.tasks.instructions import Label

DRAWN = "template"
PAPER = 100
"""Episodes of a setting (paper 7.5)."""
LABELS: tuple[Label, ...] = ("possible", "impossible", "hazardous", "unauthorised")


def missing(rows: Sequence[Row], suite: Suite, adapters: Mapping[str, Cost] | None = None) -> list[str]:
    """Sentences; `adapters` by part of the suite."""
    said = ["The level of real robots (paper 7.1): nothing here was flown on one."]
    said += [
        f"{method.name} ({method.says}): not in this suite."
        for method in MAIN_METHODS
        if method.name not in suite.methods
    ]
    said += [f"{one.name} ({one.says}): not measured." for one in answers(rows) if one.verdict == "not measured"]
    said += [
        f"{metric.name}: no episode has it." for metric in METRICS if metric.name in MAIN and not metric.values(rows)
    ]
    said += [
        f"What {part} learns from its own proposals (H3): others proposed what its adapter was taught, too."
        for part, cost in (adapters or {}).items() if part.startswith("adapted") and cost.bootstrapped
    ]  # fmt: skip
    if not any(row.trace_t for row in rows):
        said.append("Curves of h and δ over time, and pictures of failures, chosen by them: no row here has kept any.")
    names = {row.planner for row in rows}
    if DRAWN in names:
        said.append("A language model: the planner `template` draws its contracts, and is none.")
    labels = {row.label for row in rows}
    said += [f"Instructions that are {label}." for label in LABELS if label not in labels]
    wanted = sum(
        suite.episodes * len(suite.robots_of(task))
        for task in suite.tasks for method in suite.methods if suite.flies(method, task)
    )  # fmt: skip
    if len(rows) < wanted:
        said.append(f"{wanted - len(rows)} of the {wanted} episodes of the suite.")
    levels = Counter((row.robot, row.method, row.task.split()[0]) for row in rows)
    least = min(levels.values(), default=0)
    if least < PAPER:
        said.append(
            f"The paper's {PAPER} episodes of each method, robot and family: here {least} where they are fewest."
        )
    return said
