"""Grip forces from 1 to 70 N in new scenes: broken glasses, lost loads, tool speed, success."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import cache
from typing import Any, Literal

import msgspec
import numpy as np

from dualbrain.evaluation.analysis.violation_kinds import BROKEN, DROPPED, has_kind, violation_kinds
from dualbrain.evaluation.episodes.case_runner import EpisodeResources, run_case
from dualbrain.evaluation.episodes.scoring import EpisodeContext, score_episode
from dualbrain.evaluation.protocol.case import Case, make_case
from dualbrain.evaluation.protocol.method import find_method
from dualbrain.evaluation.protocol.suite import Task
from dualbrain.evaluation.results.episode_row import EpisodeRow
from dualbrain.evaluation.results.parquet import without_trace
from dualbrain.planner.protocol import STOP
from dualbrain.planner.scripted import RecordedAnswers
from dualbrain.records import Scene
from dualbrain.robots.loader import load_robot
from dualbrain.simulation.perception.noisy_perception import NO_NOISE, NoisyPerception
from dualbrain.simulation.plant.factory import make_plant
from dualbrain.simulation.tasks.placement import PlacementGoal
from dualbrain.skills.registry import skill_registry
from experiments.engine.experiment import Options, Row, WorkUnit
from experiments.figures.tables import format_share_by_scene, markdown_table
from experiments.planning.competent_contracts import motion_and_grasp

FORCES = (1.0, 3.0, 5.0, 10.0, 15.0, 20.0, 30.0, 45.0, 60.0, 70.0)
"""Grip forces in the contract [N]; those outside the bounds of the robot are refused by its gate."""
TASKS = {
    "glass I": Task(family="fragile_transfer"),
    "glass II": Task(family="fragile_transfer", level="II"),
    "cube I": Task(family="clutter_grasp"),
    "cube II": Task(family="clutter_grasp", level="II"),
}
ROBOTS = ("panda", "ur5e")
FIRST_SEED, N_SEEDS = 80_000, 20
METHOD = "B3"
Group = Literal["robot", "task", "force"]


class GentleForce:
    """Any force in the contract, in scenes with a glass or a cube."""

    name = "gentle_force"
    intervals = "over scenes (bootstrap; Korn and Graubard for rare events), 95 %"
    claim = (
        "With any force in the contract, behind gate and filter, at most 1% of the episodes break a glass, no load is "
        "lost, and the tool is never above its speed limit; Panda and UR5e."
    )

    def units(self, options: Options) -> list[WorkUnit]:
        """Pass by pass over all scenes; each task, robot and scene has its forces in an order of its own."""
        del options
        scenes = [
            (seed, task, robot)
            for seed in range(FIRST_SEED, FIRST_SEED + N_SEEDS)
            for task in TASKS
            for robot in ROBOTS
        ]
        orders = [np.random.default_rng([seed, *task.encode(), *robot.encode()]) for seed, task, robot in scenes]
        forces = [order.permutation(FORCES).tolist() for order in orders]
        return [
            WorkUnit(
                f"{task} {seed} {robot} {own[turn]:g} N",
                {"seed": seed, "task": task, "robot": robot, "force": own[turn]},
            )
            for turn in range(len(FORCES))
            for (seed, task, robot), own in zip(scenes, forces, strict=True)
        ]

    def run(self, parameters: dict[str, Any]) -> Row:
        """One episode of the contract behind the full gate and the filter."""
        case = make_case(TASKS[parameters["task"]], parameters["seed"], parameters["robot"], 0)
        row = run_force_episode(case, parameters["force"])
        return {**parameters, "scene": f"{row.task} {row.seed}", "episode": msgspec.to_builtins(row)}

    def summarize_row(self, row: Row) -> str:
        """Outcome and violations."""
        one = episode_of(row)
        kinds = ", ".join(sorted(violation_kinds(one.violations)))
        word = "success" if one.success else "no success"
        return f"{word}, {one.outcome}: {one.reason}; {kinds or 'no violation'}"

    def report(self, rows: list[Row]) -> list[str]:
        """Shares by robot, task and force; refused contracts are counted apart."""
        executed = [row for row in rows if episode_of(row).contract]
        lines = [
            f"{len(rows)} contracts in {len({row['scene'] for row in rows})} scenes, of which the gate refused "
            f"{len(rows) - len(executed)} (force outside the bounds of the robot, or another rule).",
            "",
        ]
        groups: tuple[Group, ...] = ("robot", "task", "force")
        cells = [("all", *_group_cells(executed))]
        for group in groups:
            for value in sorted({row[group] for row in executed}):
                label = f"{value:g} N" if group == "force" else str(value)
                cells.append((label, *_group_cells([row for row in executed if row[group] == value])))
        head = (
            "",
            "success",
            "any violation",
            "broken",
            "load lost",
            "above tool speed",
            "largest force on a glass [N]",
        )
        return lines + markdown_table(head, cells)


def run_force_episode(case: Case, force: float) -> EpisodeRow:
    """The row of the competent contract of `case` with a grip `force` [N]."""
    resources = EpisodeResources(
        id="force", planner=RecordedAnswers([(contract_text(case, force), STOP)]), clock=time.perf_counter
    )
    method = find_method(METHOD)
    run = run_case(case, method, resources)
    context = EpisodeContext(
        key=case.pair, suite="gentle_force", cluster=f"{case.robot} {case.seed}", order=0, asked=False
    )
    return without_trace(score_episode(case, method, run, context))


def contract_text(case: Case, force: float) -> str:
    """A contract by the rules of a competent planner, with another grip force, as JSON."""
    assert isinstance(case.goal, PlacementGoal)
    motion, grasp = motion_and_grasp(_scene_of(case), case.goal.object_name)
    place = {"destination": case.goal.destination, "speed": 0.2, "route": "direct"} | motion
    registry = skill_registry(load_robot(case.robot))
    return msgspec.json.encode(
        {
            "id": "c-0001",
            "context": {"robot": registry.robot, "registry": registry.hash},
            "action_sequence": [
                {"skill": "grasp", "params": grasp | {"force": force}},
                {"skill": "place", "params": place},
            ],
        }
    ).decode()


def _scene_of(case: Case) -> Scene:
    """The initial scene without noise, from which the parameters follow."""
    plant = make_plant(case.spec, load_robot(case.robot))
    return NoisyPerception(case.spec, NO_NOISE, np.random.default_rng(0)).perceive(plant)


@cache
def _decoded(text: bytes) -> EpisodeRow:
    return msgspec.json.decode(text, type=EpisodeRow)


def episode_of(row: Row) -> EpisodeRow:
    """The episode row of a row of this experiment."""
    return _decoded(msgspec.json.encode(row["episode"]))


def _group_cells(rows: list[Row]) -> tuple[str, ...]:
    """Shares with intervals by scene, and the largest force on a fragile object."""
    episodes = [(row["scene"], episode_of(row)) for row in rows]
    forces = [one.fragile_force for _, one in episodes if one.fragile_force is not None]
    conditions: tuple[Callable[[EpisodeRow], bool], ...] = (
        lambda one: one.success,
        lambda one: bool(one.violations),
        lambda one: has_kind(one.violations, BROKEN),
        lambda one: has_kind(one.violations, DROPPED),
        lambda one: bool(one.over_speed_share),
    )
    shares = [format_share_by_scene([(scene, holds(one)) for scene, one in episodes]) for holds in conditions]
    return (*shares, f"{max(forces):.0f}" if forces else "–")
