"""Confusion matrices: the robot's own verdict and each independent sense, against ground truth.

The episodes are those of random valid contracts (planner `template`) and of competent contracts with random grip forces
in new scenes, behind gate and filter.
"""

from __future__ import annotations

import time
from collections.abc import Iterable
from typing import Any

import msgspec
import numpy as np

from dualbrain.evaluation.analysis.sense_confusion import SenseConfusion, confirmed_success_confusion, sense_confusions
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
FIRST_SEED, N_SEEDS = 83_000, 25
FORCE_RANGE = (5.0, 60.0)
METHOD = "B3"


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
        return f"{one.outcome}, truth {one.success}, senses {one.second_opinion}: {one.reason}"

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
        claimed = [one for _, one in done if one.claimed]
        return lines + sense_table((*sense_confusions(claimed), confirmed_success_confusion(claimed)))


def _run_random(case: Case) -> EpisodeRow:
    method = find_method(METHOD)
    planner = TemplatePlanner(case.seed)
    run = run_case(case, method, EpisodeResources(id="random", planner=planner, clock=time.perf_counter))
    context = EpisodeContext(key=case.pair, suite="outcome_confusion", cluster=case.pair, order=0, asked=False)
    return without_trace(score_episode(case, method, run, context))


def sense_table(matrices: Iterable[SenseConfusion]) -> list[str]:
    """The matrices of the senses over the episodes that the robot reports as successes."""
    lines = ["Senses in the episodes that the robot reports as successes, against ground truth:", ""]
    head = ("sense", "confirmed, true", "confirmed, false", "contradicted, true", "contradicted, false", "not judged")
    cells = (
        (
            one.sense,
            one.confirmed_true,
            one.confirmed_false,
            one.contradicted_true,
            one.contradicted_false,
            one.not_judged,
        )
        for one in matrices
    )
    return lines + markdown_table(head, cells)
