"""List of what an evaluation did not measure: metrics without a value, methods and hypotheses that were not run."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence

from dualbrain.evaluation.analysis.hypotheses import evaluate_hypotheses
from dualbrain.evaluation.analysis.metrics import MAIN_METRICS, METRICS
from dualbrain.evaluation.protocol.method import MAIN_METHODS
from dualbrain.evaluation.protocol.suite import Suite
from dualbrain.evaluation.report.adaptation_cost import AdapterCost
from dualbrain.evaluation.results.episode_row import EpisodeRow
from dualbrain.simulation.tasks.instructions import Label

TEMPLATE_PLANNER = "template"
PAPER_EPISODES = 100
"""Minimum number of episodes of each setting (paper 7.5)."""
NO_TRACES = "Curves of h and δ over time, and images of failures: the rows contain no traces."
LABELS: tuple[Label, ...] = ("possible", "impossible", "hazardous", "unauthorised")


def list_not_measured(
    rows: Sequence[EpisodeRow], suite: Suite, adapters: Mapping[str, AdapterCost] | None = None
) -> list[str]:
    """One sentence for each thing that `rows` do not measure; `adapters` maps planner roles to their cost."""
    sentences = ["The level of real robots (paper 7.1): no episode ran on a real robot."]
    sentences += [
        f"{method.name} ({method.description}): not in this suite."
        for method in MAIN_METHODS
        if method.name not in suite.methods
    ]
    sentences += [
        f"{one.name} ({one.description}): not measured."
        for one in evaluate_hypotheses(rows)
        if one.verdict == "not measured"
    ]
    sentences += [
        f"{metric.name}: no episode has a value."
        for metric in METRICS
        if metric.name in MAIN_METRICS and not metric.values(rows)
    ]
    sentences += [
        f"The effect of adaptation on {role} from its own proposals (H3): other planners also proposed samples for it."
        for role, cost in (adapters or {}).items()
        if role.startswith("adapted") and cost.bootstrapped
    ]
    if not any(row.trace_t for row in rows):
        sentences.append(NO_TRACES)
    names = {row.planner for row in rows}
    if TEMPLATE_PLANNER in names:
        sentences.append("A language model: the planner “template” draws random contracts.")
    labels = {row.label for row in rows}
    sentences += [f"Instructions that are {label}." for label in LABELS if label not in labels]
    wanted = sum(
        suite.episodes_per_task * len(suite.robots_of(task))
        for task in suite.tasks
        for method in suite.methods
        if suite.includes(method, task)
    )
    if len(rows) < wanted:
        sentences.append(f"{wanted - len(rows)} of the {wanted} episodes of the suite.")
    levels = Counter((row.robot, row.method, row.task.split()[0]) for row in rows)
    least = min(levels.values(), default=0)
    if least < PAPER_EPISODES:
        sentences.append(
            f"The paper's {PAPER_EPISODES} episodes for each method, robot and family: the smallest number is {least}."
        )
    return sentences
