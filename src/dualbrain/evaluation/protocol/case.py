"""One case: a scene, what is asked in it and in which words, what counts as success, how long it may take."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import msgspec

from dualbrain.errors import InvalidSetup
from dualbrain.evaluation.protocol.suite import Task
from dualbrain.simulation.scenes.scene_spec import SceneSpec
from dualbrain.simulation.tasks.arrival import At
from dualbrain.simulation.tasks.families import assign
from dualbrain.simulation.tasks.instructions import Label, Wording
from dualbrain.simulation.tasks.placement import Goal
from dualbrain.simulation.tasks.scene_hashes import check_frozen


@dataclass(frozen=True, slots=True)
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
    goal: Goal | At | None
    time_limit: float

    @property
    def pair(self) -> str:
        """What cases of different methods share."""
        return f"{self.robot} {self.task.name} {self.seed} r{self.repetition}"


Catalogue = Callable[[Task, int, str, int], Case]
"""(task, seed, robot, repetition) → case, always the same one."""


def case_of(task: Task, seed: int, robot: str, repetition: int) -> Case:
    """The case of the paper's families; wordings go round with seed and repetition.

    Raises `UnknownName` for a family, level or ask that the robot does not have, `InvalidSetup` if a generator has
    changed since its scenes were frozen.
    """
    asked = assign(task.family, task.level, seed, robot, task.ask)
    check_frozen(task.family, task.level, seed, asked.spec)
    ways = _allowed(asked.wordings, task)
    number = (seed + repetition) % len(ways)
    words: dict[str, Any] = {name: value for name, value in asked.names.items() if name in ways[number].slots}
    return Case(
        task, seed, robot, repetition, number, ways[number].held_out, asked.spec, ways[number].words(**words),
        asked.label, asked.goal, asked.time_limit,
    )  # fmt: skip


def _allowed(ways: tuple[Wording, ...], task: Task) -> tuple[Wording, ...]:
    """The wordings that the task may use."""
    chosen = tuple(way for way in ways if way.held_out) if task.wordings == "held_out" else ways
    if not chosen:
        raise InvalidSetup(f"wordings of {task.name}", got=msgspec.to_builtins(task), allowed="at least one")
    return chosen
