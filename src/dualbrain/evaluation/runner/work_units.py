"""The work as units: an episode, or a whole run where memory grows; each with its key in the journal."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal

import msgspec

from dualbrain.evaluation.planners.factory import RANDOM_PLANNERS, planner_name
from dualbrain.evaluation.protocol import suite as seeds
from dualbrain.evaluation.protocol.method import B3, START_METHOD, Method
from dualbrain.evaluation.protocol.suite import Suite, Task

Stage = Literal["pilot", "start", "plan", "fly"]
"""The passes, in their order: ε, the common ledger, the planner's answers, the episodes themselves."""


class WorkUnit(msgspec.Struct, frozen=True, kw_only=True):
    """`seeds` are flown in order, `repetitions` times over; `count` rows come of it, keyed `key #order`."""

    stage: Stage
    key: str
    method: str
    robot: str
    task: Task
    cluster: str
    seeds: tuple[int, ...]
    repetitions: tuple[int, ...]
    done: int = 0
    """Episodes at its beginning that need not be flown again."""

    @property
    def n_episodes(self) -> int:
        """Episodes in this unit."""
        return len(self.seeds) * len(self.repetitions)

    @property
    def seed_repetition_pairs(self) -> Iterator[tuple[int, int]]:
        """(seed, repetition) in the order in which they are flown."""
        return ((seed, repetition) for repetition in self.repetitions for seed in self.seeds)

    def row_key(self, order: int) -> str:
        """The key of one of its rows."""
        return f"{self.key} #{order}"


def build_units(suite: Suite, stage: Stage) -> list[WorkUnit]:
    """All the units of one pass. Those of an earlier run come first, so that any prefix compares the same scenes."""
    if stage == "pilot":
        return _preparatory_units(suite, stage, seeds.PILOT_SEEDS, suite.memory.pilot)
    if stage == "start":
        wanted = any(arm.uses_memory for arm in suite.resolved_methods)
        return _preparatory_units(suite, stage, seeds.START_SEEDS, suite.memory.start * wanted)
    places = [(task, robot) for task in suite.tasks for robot in suite.robots_of(task)]
    arms = list(suite.resolved_methods) if stage == "fly" else _planning_methods(suite)
    return [
        unit
        for run in range(suite.runs)
        for place in places
        for arm in arms
        if suite.includes(arm.name, place[0])
        for unit in _run_units(suite, stage, place, arm, run)
    ]


def _planning_methods(suite: Suite) -> list[Method]:
    """One arm for each planner and prompt whose answers can be had beforehand: those that need no memory."""
    found: dict[tuple[str, str, str, bool], Method] = {}
    for arm in suite.resolved_methods:
        name = planner_name(suite, arm)
        if not arm.uses_memory and name not in RANDOM_PLANNERS:
            found.setdefault((name, arm.planner_role, arm.prompt_corruption, arm.constrained), arm)
    return list(found.values())


def _preparatory_units(suite: Suite, stage: Stage, apart: range, count: int) -> list[WorkUnit]:
    """`count` episodes of each errand and robot on seeds of their own, before any test."""
    method = START_METHOD if stage == "start" else B3
    return [
        WorkUnit(
            stage=stage,
            key=f"{stage} {where}",
            method=method.name,
            robot=robot,
            task=task,
            cluster=where,
            seeds=chosen,
            repetitions=(0,),
        )
        for index, task in enumerate(suite.base_tasks if count else ())
        for chosen in [tuple(apart[index * count : (index + 1) * count])]
        for robot in task.robots
        for where in [f"{robot} {task.name}"]
    ]


def _run_units(suite: Suite, stage: Stage, place: tuple[Task, str], arm: Method, run: int) -> list[WorkUnit]:
    """One run: a single unit where memory grows and where questions are asked together, else a unit an episode."""
    task, robot = place
    seeds = tuple(suite.first + index for index in range(suite.seeds) if index % suite.runs == run)
    repetitions = tuple(range(suite.repetitions))
    cluster = f"{robot} {task.name} run {run}"
    about = {"stage": stage, "method": arm.name, "robot": robot, "task": task, "cluster": cluster}
    if arm.uses_memory or stage == "plan":
        return [WorkUnit(key=f"{arm.name} {cluster}", seeds=seeds, repetitions=repetitions, **about)]
    name = f"{arm.name} {robot} {task.name}"
    return [
        WorkUnit(key=f"{name} {seed} r{repetition}", seeds=(seed,), repetitions=(repetition,), **about)
        for repetition in repetitions
        for seed in seeds
    ]
