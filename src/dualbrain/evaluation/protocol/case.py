"""One case: a scene, what is asked in it and in which words, what counts as success, how long it may take."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import msgspec

from dualbrain.errors import ConfigurationError
from dualbrain.evaluation.protocol.suite import Task
from dualbrain.simulation.scenes.scene_spec import SceneSpec
from dualbrain.simulation.tasks.arrival import ArrivalGoal
from dualbrain.simulation.tasks.families import make_task
from dualbrain.simulation.tasks.instructions import InstructionTemplate, Label
from dualbrain.simulation.tasks.placement import PlacementGoal
from dualbrain.simulation.tasks.scene_hashes import check_scene_hash


@dataclass(frozen=True, slots=True, kw_only=True)
class Case:
    """What one episode is about. `time_limit` [s] of simulated time from the question; `goal` None: nothing is to move.

    `seed` makes the scene, `repetition` what else is drawn (perception, words); cases of different methods that differ
    in neither are paired. `held_out`: no training saw these words.
    """

    task: Task
    seed: int
    robot: str
    repetition: int
    wording: int
    held_out: bool
    spec: SceneSpec
    instruction: str
    label: Label
    goal: PlacementGoal | ArrivalGoal | None
    time_limit: float

    @property
    def pair(self) -> str:
        """What cases of different methods share."""
        return f"{self.robot} {self.task.name} {self.seed} r{self.repetition}"


CaseFactory = Callable[[Task, int, str, int], Case]
"""(task, seed, robot, repetition) → case, always the same one."""


def make_case(task: Task, seed: int, robot: str, repetition: int) -> Case:
    """The case of the paper's families; wordings go round with seed and repetition.

    Raises `UnknownName` for a family, level or ask that the robot does not have, `InvalidSetup` if a generator has
    changed since its scenes were frozen.
    """
    asked = make_task(task.family, task.level, seed, robot, task.ask)
    check_scene_hash(task.family, task.level, seed, asked.spec)
    ways = _allowed_wordings(asked.templates, task)
    number = (seed + repetition) % len(ways)
    words: dict[str, Any] = {name: value for name, value in asked.slot_values.items() if name in ways[number].slots}
    return Case(
        task=task,
        seed=seed,
        robot=robot,
        repetition=repetition,
        wording=number,
        held_out=ways[number].is_held_out,
        spec=asked.spec,
        instruction=ways[number].render(**words),
        label=asked.label,
        goal=asked.goal,
        time_limit=asked.time_limit,
    )


def _allowed_wordings(ways: tuple[InstructionTemplate, ...], task: Task) -> tuple[InstructionTemplate, ...]:
    """The wordings that the task may use."""
    chosen = tuple(way for way in ways if way.is_held_out) if task.wordings == "held_out" else ways
    if not chosen:
        raise ConfigurationError(f"wordings of {task.name}", got=msgspec.to_builtins(task), allowed="at least one")
    return chosen
