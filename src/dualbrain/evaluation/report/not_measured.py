"""What was not measured, said openly: metrics without a value, methods and hypotheses that were not flown."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence

from dualbrain.evaluation.analysis.hypotheses import evaluate_hypotheses
from dualbrain.evaluation.analysis.metrics import MAIN_METRICS, METRICS
from dualbrain.evaluation.protocol.method import MAIN_METHODS as MAIN_METHODS
from dualbrain.evaluation.protocol.suite import Suite
from dualbrain.evaluation.report.adaptation_cost import AdapterCost
from dualbrain.evaluation.results.episode_row import EpisodeRow
from dualbrain.simulation.tasks.instructions import Label

TEMPLATE_PLANNER = "template"
PAPER_EPISODES = 100
"""Episodes of a setting (paper 7.5)."""
LABELS: tuple[Label, ...] = ("possible", "impossible", "hazardous", "unauthorised")


def list_not_measured(
    rows: Sequence[EpisodeRow], suite: Suite, adapters: Mapping[str, AdapterCost] | None = None
) -> list[str]:
    """Sentences; `adapters` by part of the suite."""
    said = ["The level of real robots (paper 7.1): nothing here was flown on one."]
    said += [
        f"{method.name} ({method.description}): not in this suite."
        for method in MAIN_METHODS
        if method.name not in suite.methods
    ]
    said += [
        f"{one.name} ({one.description}): not measured."
        for one in evaluate_hypotheses(rows)
        if one.verdict == "not measured"
    ]
    said += [
        f"{metric.name}: no episode has it."
        for metric in METRICS
        if metric.name in MAIN_METRICS and not metric.values(rows)
    ]
    said += [
        f"What {part} learns from its own proposals (H3): others proposed what its adapter was taught, too."
        for part, cost in (adapters or {}).items()
        if part.startswith("adapted") and cost.bootstrapped
    ]
    if not any(row.trace_t for row in rows):
        said.append("Curves of h and δ over time, and pictures of failures, chosen by them: no row here has kept any.")
    names = {row.planner for row in rows}
    if TEMPLATE_PLANNER in names:
        said.append("A language model: the planner `template` draws its contracts, and is none.")
    labels = {row.label for row in rows}
    said += [f"Instructions that are {label}." for label in LABELS if label not in labels]
    wanted = sum(
        suite.episodes_per_task * len(suite.robots_of(task))
        for task in suite.tasks
        for method in suite.methods
        if suite.includes(method, task)
    )
    if len(rows) < wanted:
        said.append(f"{wanted - len(rows)} of the {wanted} episodes of the suite.")
    levels = Counter((row.robot, row.method, row.task.split()[0]) for row in rows)
    least = min(levels.values(), default=0)
    if least < PAPER_EPISODES:
        said.append(
            f"The paper's {PAPER_EPISODES} episodes of each method, robot and family: here {least} where they are fewest."
        )
    return said
