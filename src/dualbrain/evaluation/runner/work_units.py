"""Units of work of an evaluation: an episode, or a whole run if memory grows; each with its key in the log."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal

import msgspec

from dualbrain.evaluation.planners.factory import RANDOM_PLANNERS, planner_name
from dualbrain.evaluation.protocol.method import B3, START_METHOD, Method
from dualbrain.evaluation.protocol.suite import PILOT_SEEDS, START_SEEDS, Suite, Task

Stage = Literal["pilot", "start", "plan", "fly"]
"""The stages in their order: pilot episodes for ε, the common start ledger, the planner's answers, the episodes.

The names are also those of the logs in the results folder.
"""
STAGE_TITLES: dict[Stage, str] = {
    "pilot": "pilot episodes",
    "start": "initial ledger",
    "plan": "planner answers",
    "fly": "episodes",
}
"""The titles of the stages in messages."""


class WorkUnit(msgspec.Struct, frozen=True, kw_only=True):
    """Episodes on all `seeds` in order, once per repetition; each leaves one row, keyed `key #order`."""

    stage: Stage
    key: str
    method: str
    robot: str
    task: Task
    cluster: str
    seeds: tuple[int, ...]
    repetitions: tuple[int, ...]
    done: int = 0
    """Number of episodes at the beginning of the unit that are finished."""

    @property
    def n_episodes(self) -> int:
        """Number of episodes in this unit."""
        return len(self.seeds) * len(self.repetitions)

    @property
    def seed_repetition_pairs(self) -> Iterator[tuple[int, int]]:
        """(seed, repetition) of each episode, in the order in which they run."""
        return ((seed, repetition) for repetition in self.repetitions for seed in self.seeds)

    def row_key(self, order: int) -> str:
        """The key of the row of episode number `order`."""
        return f"{self.key} #{order}"


def all_clusters(suite: Suite) -> list[str]:
    """The clusters of the episodes: each run of each task on each robot, whichever methods take part."""
    places = [(task, robot) for task in suite.tasks for robot in suite.robots_of(task)]
    return [_cluster(place, run) for run in range(suite.runs) for place in places]


def _cluster(place: tuple[Task, str], run: int) -> str:
    task, robot = place
    return f"{robot} {task.name} run {run}"


def build_units(suite: Suite, stage: Stage) -> list[WorkUnit]:
    """All units of one stage, run by run, so that any prefix compares the methods on the same scenes."""
    if stage == "pilot":
        return _preparatory_units(suite, stage, PILOT_SEEDS, suite.memory.pilot)
    if stage == "start":
        needed = any(method.uses_memory for method in suite.resolved_methods)
        return _preparatory_units(suite, stage, START_SEEDS, suite.memory.start * needed)
    places = [(task, robot) for task in suite.tasks for robot in suite.robots_of(task)]
    methods = list(suite.resolved_methods) if stage == "fly" else _planning_methods(suite)
    return [
        unit
        for run in range(suite.runs)
        for place in places
        for method in methods
        if suite.includes(method.name, place[0])
        for unit in _run_units(suite, stage, place, method, run)
    ]


def _planning_methods(suite: Suite) -> list[Method]:
    """One method for each planner and prompt whose requests can be made beforehand: methods without memory."""
    found: dict[tuple[str, str, str, bool], Method] = {}
    for method in suite.resolved_methods:
        name = planner_name(suite, method)
        if not method.uses_memory and name not in RANDOM_PLANNERS:
            key = (name, method.planner_role, method.prompt_corruption, method.constrained)
            found.setdefault(key, method)
    return list(found.values())


def _preparatory_units(suite: Suite, stage: Stage, reserved_seeds: range, count: int) -> list[WorkUnit]:
    """`count` episodes of each base task and robot on reserved seeds, which no test uses."""
    method = START_METHOD if stage == "start" else B3
    return [
        WorkUnit(
            stage=stage,
            key=f"{stage} {where}",
            method=method.name,
            robot=robot,
            task=task,
            cluster=where,
            seeds=chosen_seeds,
            repetitions=(0,),
        )
        for index, task in enumerate(suite.base_tasks if count else ())
        for chosen_seeds in [tuple(reserved_seeds[index * count : (index + 1) * count])]
        for robot in task.robots
        for where in [f"{robot} {task.name}"]
    ]


def _run_units(suite: Suite, stage: Stage, place: tuple[Task, str], method: Method, run: int) -> list[WorkUnit]:
    """The units of one run: a single one if memory grows or requests are batched, else one per episode."""
    task, robot = place
    seeds = tuple(suite.first + index for index in range(suite.seeds) if index % suite.runs == run)
    repetitions = tuple(range(suite.repetitions))
    cluster = _cluster(place, run)
    common = {"stage": stage, "method": method.name, "robot": robot, "task": task, "cluster": cluster}
    if method.uses_memory or stage == "plan":
        return [WorkUnit(key=f"{method.name} {cluster}", seeds=seeds, repetitions=repetitions, **common)]
    name = f"{method.name} {robot} {task.name}"
    return [
        WorkUnit(key=f"{name} {seed} r{repetition}", seeds=(seed,), repetitions=(repetition,), **common)
        for repetition in repetitions
        for seed in seeds
    ]
