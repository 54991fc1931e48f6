"""Falls of h below 0 in filtered episodes: how many, their causes, and both with margins kept and not kept."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterator
from typing import Any

import msgspec
import numpy as np

from dualbrain.evaluation.episodes.case_runner import EpisodeResources, run_case
from dualbrain.evaluation.planners.template import TemplatePlanner
from dualbrain.evaluation.protocol.case import make_case
from dualbrain.evaluation.protocol.method import find_method
from dualbrain.evaluation.protocol.suite import Task
from dualbrain.records import MarginCause
from experiments.engine.experiment import Options, Row, WorkUnit
from experiments.figures.tables import format_proportion, markdown_table
from experiments.safety.closed_loop import count_violations, judgement_fields, outcome_fields, succeeded

TASKS = (
    ("panda", "clutter_grasp", "II"),
    ("panda", "dynamic_obstacle", "I"),
    ("panda", "edge_rescue", "II"),
    ("ur5e", "fragile_transfer", "II"),
    ("panda", "clutter_grasp", "I"),
    ("panda", "dynamic_obstacle", "II"),
    ("ur5e", "clutter_grasp", "II"),
    ("panda", "fragile_transfer", "II"),
    ("ur5e", "dynamic_obstacle", "II"),
    ("panda", "edge_rescue", "I"),
    ("ur5e", "edge_rescue", "II"),
    ("panda", "fragile_transfer", "I"),
)
"""Robot, family and level; those in which h fell below 0 most often before come first."""
FIRST_SEED, SEEDS = 72_100, 10
ARMS = {"not kept": False, "kept": True}
"""`ControlLoopConfig.keep_margins` of both arms."""
LIMIT = -1e-3
"""h [m] below which no episode may fall."""


class MarginCauses:
    """Margins stay intact unless something really changes, and every fall of h below 0 has a cause."""

    name = "margin_causes"
    claim = "h falls below 0 in at most 2 % of the filtered episodes, never below −1 mm, and each fall has a cause."

    def units(self, options: Options) -> list[WorkUnit]:
        """Seed by seed, every task in turn; a unit is one scene with one contract in both arms."""
        del options
        return [
            WorkUnit(
                f"{robot} {family} {level} {seed}", {"robot": robot, "family": family, "level": level, "seed": seed}
            )
            for seed in range(FIRST_SEED, FIRST_SEED + SEEDS)
            for robot, family, level in TASKS
        ]

    def run(self, parameters: dict[str, Any]) -> Row:
        """Run the task in both arms, with the same scene, perception noise and planner seed."""
        return {**parameters, "arms": {name: _run_arm(parameters, keep) for name, keep in ARMS.items()}}

    def summarize_row(self, row: Row) -> str:
        """H and the causes of both arms."""
        return "; ".join(f"{name}: {_describe(arm)}" for name, arm in row["arms"].items())

    def report(self, rows: list[Row]) -> list[str]:
        """Shares of episodes with h < 0 by arm and task, the causes, and success and Δ in pairs."""
        valid = [row for row in rows if all(arm["h_min"] is not None for arm in row["arms"].values())]
        return [
            f"Episodes with motion in both arms: {len(valid)} of {len(rows)}, each once per arm.",
            "",
            *_share_table(valid),
            *_cause_table(valid),
            *_cost_table(valid),
            *_deepest(valid),
        ]


def _run_arm(parameters: dict[str, Any], keep: bool) -> Row:
    task = Task(family=parameters["family"], level=parameters["level"])
    case = make_case(task, parameters["seed"], parameters["robot"], 0)
    resources = EpisodeResources(
        id="margins", planner=TemplatePlanner(parameters["seed"]), clock=time.monotonic, keep_margins=keep
    )
    run = run_case(case, find_method("B3"), resources)
    outcome = run.episode.outcome
    shortfalls = msgspec.to_builtins(outcome.margin_shortfalls)
    return {**outcome_fields(outcome), **judgement_fields(run.episode.judgement), "shortfalls": shortfalls}


def _describe(arm: Row) -> str:
    causes = Counter(_label(one) for one in arm["shortfalls"])
    h = "no motion" if arm["h_min"] is None else f"h {1e3 * arm['h_min']:.2f} mm"
    return ", ".join([arm["outcome"], h, *(f"{count} × {cause}" for cause, count in causes.items())])


def _label(shortfall: Row) -> str:
    """The cause, and whether the margin was introduced at a rate."""
    return shortfall["cause"] + (" (introduced)" if shortfall["introduced"] else "")


def _arms(rows: list[Row]) -> Iterator[tuple[str, list[Row]]]:
    for name in ARMS:
        yield name, [row["arms"][name] for row in rows]


def _share_table(rows: list[Row]) -> list[str]:
    groups = {"all": rows}
    for row in rows:
        groups.setdefault(f"{row['robot']} {row['family']} {row['level']}", []).append(row)
    lines: list[list[object]] = []
    for group, members in groups.items():
        for name, arms in _arms(members):
            short = sum(arm["h_min"] < 0.0 for arm in arms)
            deep = sum(arm["h_min"] < LIMIT for arm in arms)
            introduced = sum(any(one["introduced"] for one in arm["shortfalls"]) for arm in arms)
            least = f"{1e3 * min((arm['h_min'] for arm in arms), default=0.0):.2f}"
            lines.append([group, name, format_proportion(short, len(arms)), deep, least, introduced])
    head = ("task", "margins", "episodes with h < 0", "below −1 mm", "least h [mm]", "with an introduced margin")
    return markdown_table(head, lines)


def _cause_table(rows: list[Row]) -> list[str]:
    """Number of episodes (and intervals) by cause."""
    lines: list[list[object]] = []
    for cause in (*(one.value for one in MarginCause), *(f"{one.value} (introduced)" for one in MarginCause)):
        cells: list[object] = []
        for _, arms in _arms(rows):
            counts = [sum(_label(one) == cause for one in arm["shortfalls"]) for arm in arms]
            cells.append(f"{sum(map(bool, counts))} ({sum(counts)})")
        if any(cell != "0 (0)" for cell in cells):
            lines.append([cause, *cells])
    return markdown_table(("cause: episodes (intervals)", *ARMS), lines)


def _cost_table(rows: list[Row]) -> list[str]:
    lines: list[list[object]] = []
    for name, arms in _arms(rows):
        delta = [arm["Delta"] for arm in arms if arm["Delta"] is not None]
        times = [arm["duration"] for arm in arms if succeeded(arm)]
        mean, median = float(np.mean(delta or [0.0])), float(np.median(times or [0.0]))
        done = format_proportion(sum(map(succeeded, arms)), len(arms))
        kinds = ", ".join(f"{n} × {kind}" for kind, n in sorted(count_violations(arms).items())) or "none"
        lines.append([name, done, f"{mean:.5f}", f"{median:.1f}", kinds])
    pairs = [(succeeded(row["arms"]["not kept"]), succeeded(row["arms"]["kept"])) for row in rows]
    lost, won = sum(a and not b for a, b in pairs), sum(b and not a for a, b in pairs)
    return [
        *markdown_table(("margins", "success", "mean Δ", "median motion [s]", "violations"), lines),
        f"Pairs: {lost} succeed only with margins not kept, {won} only with margins kept.",
        "",
    ]


def _deepest(rows: list[Row]) -> list[str]:
    """Every episode with h < 0 while margins are kept."""
    lines: list[str] = []
    for row in rows:
        arm = row["arms"]["kept"]
        if arm["h_min"] < 0.0:
            found = min((one for one in arm["shortfalls"] if not one["introduced"]), key=lambda one: one["h_min"])
            lines.append(f"- {row['key']}: {1e3 * arm['h_min']:.2f} mm, {found['pair']}, {found['cause']}")
    return ["Episodes with h < 0 while margins are kept:", "", *(lines or ["- none"])]
