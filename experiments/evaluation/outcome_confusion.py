"""Confusion matrices: the robot's own verdict and each independent sense, against ground truth.

The episodes are those of random valid contracts (planner `template`) and of competent contracts with random grip forces
in new scenes, behind gate and filter. A sense is every column of the rows with the values "agrees" and "disagrees", so
that a sense that is added later needs no change here.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable
from typing import Any

import msgspec
import numpy as np

from dualbrain.evaluation.episodes.case_runner import EpisodeResources, run_case
from dualbrain.evaluation.episodes.scoring import EpisodeContext, score_episode
from dualbrain.evaluation.planners.template import TemplatePlanner
from dualbrain.evaluation.protocol.case import Case, make_case
from dualbrain.evaluation.protocol.method import find_method
from dualbrain.evaluation.protocol.suite import Task
from dualbrain.evaluation.results.episode_row import EpisodeRow
from dualbrain.evaluation.results.parquet import without_trace
from experiments.engine.experiment import Options, Row, WorkUnit
from experiments.evaluation.gentle_force import episode_of, run_force_episode
from experiments.figures.tables import format_share_by_scene, markdown_table

FAMILIES = ("fragile_transfer", "clutter_grasp", "edge_rescue", "dynamic_obstacle")
FIRST_SEED, N_SEEDS = 81_000, 25
FORCE_RANGE = (5.0, 60.0)
METHOD = "B3"
ANSWERS = ("agrees", "disagrees", "none")
TRUTHS: dict[str, Callable[[EpisodeRow], bool]] = {
    "intact": lambda row: not any(one.kind == "force_fragile" for one in row.violations),
    "held": lambda row: not any(one.kind == "object_dropped" for one in row.violations),
    "moved": lambda row: not any(one.kind.startswith("bystander") for one in row.violations),
}
"""Truth of a sense by a part of its name; of every other sense the success of the task."""


class OutcomeConfusion:
    """The robot's reports are true."""

    name = "outcome_confusion"
    intervals = "over scenes (bootstrap; Korn and Graubard for rare events), 95 %"
    claim = (
        "At most 1% of the reports of success are false and at most 2% of the reports of failure, on ground truth, and "
        "each independent sense contradicts the false ones."
    )

    def units(self, options: Options) -> list[WorkUnit]:
        """Scene by scene, every family and level, with a random and with a competent contract."""
        del options
        return [
            WorkUnit(
                f"{family} {level} {seed} {planner}", {"family": family, "level": level, "seed": seed, "by": planner}
            )
            for seed in range(FIRST_SEED, FIRST_SEED + N_SEEDS)
            for family in FAMILIES
            for level in ("I", "II")
            for planner in ("competent", "random")
        ]

    def run(self, parameters: dict[str, Any]) -> Row:
        """One episode."""
        case = make_case(Task(family=parameters["family"], level=parameters["level"]), parameters["seed"], "panda", 0)
        if parameters["by"] == "competent":
            force = float(np.random.default_rng(case.seed).uniform(*FORCE_RANGE))
            episode = run_force_episode(case, round(force, 1))
        else:
            episode = _run_random(case)
        scene = f"{episode.task} {episode.seed}"
        return {**parameters, "scene": scene, "episode": msgspec.to_builtins(episode)}

    def summarize_row(self, row: Row) -> str:
        """Outcome and truth."""
        one = episode_of(row)
        return f"{one.outcome}, truth {one.success}, {senses(one)}: {one.reason}"

    def report(self, rows: list[Row]) -> list[str]:
        """The robot's verdict and every sense against ground truth."""
        done = [(row["scene"], episode_of(row)) for row in rows if episode_of(row).Delta is not None]
        claims = [(scene, not one.success) for scene, one in done if one.claimed]
        failures = [(scene, one.success) for scene, one in done if not one.claimed]
        lines = [
            f"{len(done)} executed contracts in {len({scene for scene, _ in done})} scenes. Reports of success that "
            f"are false: **{format_share_by_scene(claims)}**; reports of failure that are false: "
            f"{format_share_by_scene(failures)}.",
            "",
        ]
        for name in sorted({name for _, one in done for name in senses(one)}):
            lines += sense_table(name, [one for _, one in done if one.claimed])
        return lines


def _run_random(case: Case) -> EpisodeRow:
    method = find_method(METHOD)
    planner = TemplatePlanner(case.seed)
    run = run_case(case, method, EpisodeResources(id="random", planner=planner, clock=time.perf_counter))
    context = EpisodeContext(key=case.pair, suite="outcome_confusion", cluster=case.pair, order=0, asked=False)
    return without_trace(score_episode(case, method, run, context))


def senses(row: EpisodeRow) -> dict[str, str]:
    """The senses of a row by name: every column that has one of the values of `ANSWERS`."""
    values = {name: getattr(row, name) for name in row.__struct_fields__}
    return {name: value for name, value in values.items() if isinstance(value, str) and value in ANSWERS}


def truth_for(name: str) -> Callable[[EpisodeRow], bool]:
    """The ground truth with which a sense is compared."""
    return next((truth for part, truth in TRUTHS.items() if part in name), lambda row: row.success)


def sense_table(name: str, claimed: list[EpisodeRow]) -> list[str]:
    """The matrix of one sense over the episodes that the robot reports as successes."""
    truth = truth_for(name)
    counts = Counter((senses(one).get(name, "none"), truth(one)) for one in claimed)
    lines = [f"Sense `{name}`, in the episodes that the robot reports as successes:", ""]
    head = ("sense ↓, ground truth →", "true", "false")
    return lines + markdown_table(head, ((answer, counts[answer, True], counts[answer, False]) for answer in ANSWERS))
