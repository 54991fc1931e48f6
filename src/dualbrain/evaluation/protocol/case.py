"""Cases: a scene, an instruction, the goal that counts as success, and the time limit."""

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
    """The task of one episode. `goal` is None if nothing may move.

    `time_limit` [s] is simulated time from the planner request on. `seed` determines the scene, `repetition` the other
    random choices (perception noise, wording); cases of different methods with the same seed and repetition are paired.
    `held_out`: no training data contains this wording.
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
        """The key that paired cases of different methods share."""
        return f"{self.robot} {self.task.name} {self.seed} r{self.repetition}"


CaseFactory = Callable[[Task, int, str, int], Case]
"""(task, seed, robot, repetition) → case; deterministic."""


def make_case(task: Task, seed: int, robot: str, repetition: int) -> Case:
    """The case of one of the paper's families; seed and repetition cycle through the wordings.

    Raises:
        UnknownNameError: the robot has no such family, level or request type.
        ConfigurationError: the scene generator has changed since its scenes were hashed, or no wording is allowed.
    """
    made = make_task(task.family, task.level, seed, robot, task.ask)
    check_scene_hash(task.family, task.level, seed, made.spec)
    wordings = _allowed_wordings(made.templates, task)
    number = (seed + repetition) % len(wordings)
    template = wordings[number]
    values: dict[str, Any] = {name: value for name, value in made.slot_values.items() if name in template.slots}
    return Case(
        task=task,
        seed=seed,
        robot=robot,
        repetition=repetition,
        wording=number,
        held_out=template.is_held_out,
        spec=made.spec,
        instruction=template.render(**values),
        label=made.label,
        goal=made.goal,
        time_limit=made.time_limit,
    )


def _allowed_wordings(templates: tuple[InstructionTemplate, ...], task: Task) -> tuple[InstructionTemplate, ...]:
    """The wordings that the task may use."""
    chosen = tuple(one for one in templates if one.is_held_out) if task.wordings == "held_out" else templates
    if not chosen:
        raise ConfigurationError(f"wordings of {task.name}", got=msgspec.to_builtins(task), allowed="at least one")
    return chosen
