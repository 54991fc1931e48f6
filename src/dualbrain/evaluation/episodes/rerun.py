"""Rerun of a reported episode from its recorded answers: the same motion, with an observer."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from dualbrain.control.control_loop import TickSnapshot
from dualbrain.evaluation.episodes.case_runner import Clock, EpisodeResources, EpisodeRun, run_case
from dualbrain.evaluation.protocol.case import CaseFactory, make_case
from dualbrain.evaluation.protocol.method import find_method
from dualbrain.evaluation.protocol.suite import Suite
from dualbrain.evaluation.results.episode_row import EpisodeRow
from dualbrain.memory.embedding.image_features import ImageFeatures
from dualbrain.planner.scripted import RecordedAnswers
from dualbrain.simulation.plant.plant import Plant


@dataclass(frozen=True, slots=True)
class RerunHooks:
    """Observers of a rerun: `on_open` gets the plant before any motion, `on_tick` a snapshot every snapshot period."""

    on_open: Callable[[Plant], None] = lambda plant: None
    on_tick: Callable[[TickSnapshot], None] | None = None
    visuals: bool = False


def rerun_episode(
    row: EpisodeRow, suite: Suite, clock: Clock, hooks: RerunHooks, make_case: CaseFactory = make_case
) -> EpisodeRun:
    """Run the episode of `row` again; memory is not needed, because the answers are recorded."""
    task = next(task for task in suite.tasks if task.name == row.task)
    case = make_case(task, row.seed, row.robot, row.repetition)

    def open_plant(plant: Plant) -> ImageFeatures | None:
        hooks.on_open(plant)
        return None

    resources = EpisodeResources(
        id="again",
        planner=RecordedAnswers(row.answers),
        clock=clock,
        max_shots=max(1, len(row.answers)),
        planning_time=suite.planning_time,
        on_tick=hooks.on_tick,
        image_features=open_plant,
        visuals=hooks.visuals,
        target=suite.target,
    )
    return run_case(case, find_method(row.method), resources)


def find_differences(row: EpisodeRow, run: EpisodeRun) -> list[str]:
    """Differences between `run` and the recorded row; none on the same machine and code."""
    outcome, judgement = run.episode.outcome, run.episode.judgement
    pairs = {
        "outcome": (row.outcome, outcome.kind),
        "reason": (row.reason, outcome.reason),
        "Δ": (row.Delta, outcome.Delta if row.Delta is not None else None),
        "h_min": (row.h_min, outcome.h_min),
        "motion": (row.motion_s, outcome.duration),
        "violations": (len(row.violations), len(judgement.violations) if judgement else 0),
    }
    return [f"{name}: {before}, now {now}" for name, (before, now) in pairs.items() if before != now]
