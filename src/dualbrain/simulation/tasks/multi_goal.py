"""Tasks with several goals: ordered or unordered, for all objects of a colour or category, or with a condition.

A goal sequence consists of consecutive stages; the goals of one stage may be reached in any order. An instruction is
parsed once, for the initial scene: "all the red things" are the red objects of that scene, and a condition is evaluated
in that scene. Success is judged on simulator ground truth; for evaluation only.
"""

from __future__ import annotations

import re
from itertools import pairwise

import msgspec
import numpy as np

from dualbrain.core.geometry.shapes import Bowl
from dualbrain.errors import ConfigurationError
from dualbrain.simulation.plant.plant import Plant
from dualbrain.simulation.scenes.scene_spec import ObjectSpec, SceneSpec
from dualbrain.simulation.tasks.arrival import ArrivalGoal, ArrivalJudge
from dualbrain.simulation.tasks.placement import PlacementGoal, PlacementJudge, is_inside_bowl, is_placed, parse_goal

HOME_TOLERANCE, MAX_HOME_SPEED = 0.05, 0.02
"""An arm is at home if every joint is within this of its home position [rad] and slower than this [rad/s]."""
MAX_UNMOVED_DISTANCE = 0.03
"""An object within this distance of its initial position counts as not moved [m]."""


class HomeGoal(msgspec.Struct, frozen=True):
    """The arm rests in its home posture."""


SingleGoal = PlacementGoal | ArrivalGoal | HomeGoal


class GoalSequence(msgspec.Struct, frozen=True):
    """Goals by stage: the goals of a stage are reached after all goals of the previous stage, and hold at the end.

    Of several places that a base drives to, only the last must hold at the end. Without stages, no object may be moved.
    """

    stages: tuple[tuple[SingleGoal, ...], ...]


def parse_goals(instruction: str, spec: SceneSpec) -> PlacementGoal | ArrivalGoal | GoalSequence:
    """The goal of `instruction` in `spec`: one goal as in `parse_goal`, or several.

    Forms: "A, then B"; "A and B" in any order, each with its verb; "put all the red things in Y", by colour or
    category; "if Y is free, A, else B" (also empty, occupied, full; without else no object may be moved); "go home".
    Raises `ConfigurationError` for another form and `UnknownNameError` for names that are not in the scene.
    """
    text = " ".join(instruction.split()).rstrip(".").lower()  # single spaces: the expressions take linear time
    condition = re.fullmatch(
        r"if (?:the )?(.+?) is (free|empty|occupied|full),? (.+?)(?:,? (?:else|otherwise),? (.+))?", text
    )
    if condition:
        container, state, then, other = condition.groups()
        chosen = then if _is_empty(container.replace(" ", "_"), spec) == (state in ("free", "empty")) else other
        return parse_goals(chosen, spec) if chosen else GoalSequence(())
    stages = tuple(_parse_stage(part, spec) for part in re.split(r"(?:, ?|\b ?and ?|; ?| )then ", text))
    goals = [goal for stage in stages for goal in stage]
    return goals[0] if len(goals) == 1 and isinstance(goals[0], PlacementGoal | ArrivalGoal) else GoalSequence(stages)


def _parse_stage(text: str, spec: SceneSpec) -> tuple[SingleGoal, ...]:
    parts = re.split(r",? and (?=(?:put|place|move|go|drive)\b)", text.strip())
    return tuple(goal for part in parts for goal in _parse_clause(part.strip(), spec))


def _parse_clause(text: str, spec: SceneSpec) -> tuple[SingleGoal, ...]:
    if re.fullmatch(r"(?:go|return|drive) home", text):
        return (HomeGoal(),)
    every = re.fullmatch(
        r"(?:put|place|move) (?:all|every one)(?: of)?(?: the)? (.+?) (in|into|on|onto|to|at) (.+)", text
    )
    if every is None:
        return (parse_goal(text, spec),)
    group, preposition, destination = every.groups()
    found = [obj for obj in spec.objects if obj.role == "object" and _is_in_group(obj, group)]
    if not found:
        known = sorted({word for obj in spec.objects if obj.role == "object" for word in (obj.colour, obj.category)})
        allowed = f"a colour or category of the scene: {', '.join(known)}"
        raise ConfigurationError("group of objects", got=group, allowed=allowed)
    return tuple(parse_goal(f"put {obj.name} {preposition} {destination}", spec) for obj in found)


def _is_in_group(obj: ObjectSpec, group: str) -> bool:
    """Whether `group` ("red ones", "red things", "tins", "red tins") includes `obj`."""
    words = [word for word in group.split() if word not in ("ones", "things", "objects", "one", "thing", "object")]
    return bool(words) and all(word.removesuffix("s") in (obj.colour, obj.category) for word in words)


def _is_empty(container: str, spec: SceneSpec) -> bool:
    """Whether no object is in `container`; raises `UnknownNameError`, or `ConfigurationError` for another object."""
    bowl = spec.find(container)
    if not isinstance(bowl.shape, Bowl):
        raise ConfigurationError("container in the condition", got=container, allowed="the name of a bowl")
    others = (obj for obj in spec.objects if obj.role == "object")
    return not any(is_inside_bowl(obj.position, bowl.position, bowl.shape) for obj in others)


class GoalSequenceJudge:
    """Judges a goal sequence during an episode: call `update` every 20 ms, then `score`.

    The interval is short, because a base rests only briefly at an intermediate place.
    """

    def __init__(self, plant: Plant, sequence: GoalSequence) -> None:
        """Record the initial positions; raises `UnknownNameError` for names that are not in the scene."""
        self._plant, self._sequence = plant, sequence
        self._judges = [[make_single_judge(plant, goal) for goal in stage] for stage in sequence.stages]
        self._first_reached: dict[tuple[int, int], float] = {}
        self._free_objects = [obj.name for obj in plant.spec.objects if obj.role == "object" and not obj.fixed]
        self._start_positions = {name: np.array(plant.true_pose(name).position) for name in self._free_objects}

    def update(self) -> None:
        """Record when each goal was first reached."""
        for i, stage in enumerate(self._judges):
            for j, judge in enumerate(stage):
                judge.update()
                goal = self._sequence.stages[i][j]
                # `is_placed` is cheap and excludes most steps
                near = not isinstance(goal, PlacementGoal) or is_placed(self._plant, goal)
                if (i, j) not in self._first_reached and near and judge.score()[0]:
                    self._first_reached[i, j] = self._plant.now

    def score(self) -> tuple[bool, float]:
        """Success, and progress in [0, 1] as the mean over all goals."""
        if not self._sequence.stages:
            still = all(
                np.linalg.norm(self._start_positions[name] - self._plant.true_pose(name).position)
                < MAX_UNMOVED_DISTANCE
                for name in self._free_objects
            )
            return still, float(still)
        self.update()
        progress = [self._progress(i, j) for i, stage in enumerate(self._judges) for j in range(len(stage))]
        if all(one == 1.0 for one in progress) and self._is_in_order():
            return True, 1.0
        return False, min(0.99, float(np.mean(progress)))

    def _progress(self, i: int, j: int) -> float:
        """Progress of goal j of stage i; a place that was reached counts as reached, except in the last stage."""
        success, progress = self._judges[i][j].score()
        passed = isinstance(self._sequence.stages[i][j], ArrivalGoal | HomeGoal) and i < len(self._sequence.stages) - 1
        return 1.0 if success or (passed and (i, j) in self._first_reached) else progress

    def _is_in_order(self) -> bool:
        times = [[self._first_reached[i, j] for j in range(len(stage))] for i, stage in enumerate(self._judges)]
        return all(max(before) <= min(after) for before, after in pairwise(times))


class HomeJudge:
    """Judges whether the arm of a plant rests in its home posture, independent of the pose of a base."""

    def __init__(self, plant: Plant) -> None:
        """Judge the arm of `plant`."""
        self._plant = plant

    def update(self) -> None:
        """Do nothing: this goal has no intermediate progress."""

    def score(self) -> tuple[bool, float]:
        """Success, and progress 0 or 1."""
        q = self._plant.data.qpos[self._plant.arm_slices[0]]
        at_home = float(np.max(np.abs(q - np.array(self._plant.robot_model.home)[-len(q) :]))) < HOME_TOLERANCE
        still = bool(np.all(np.abs(self._plant.robot_velocity()) < MAX_HOME_SPEED))
        return at_home and still, float(at_home and still)


def can_be_judged(goal: SingleGoal, plant: Plant) -> bool:
    """Whether the scene of `plant` has the object and the destination of `goal`, or its place."""
    places = {place.name for place in plant.spec.places}
    match goal:
        case ArrivalGoal():
            return goal.place in places
        case HomeGoal():
            return True
        case PlacementGoal():
            bowls = {obj.name for obj in plant.spec.objects if isinstance(obj.shape, Bowl)}
            return goal.object_name in plant.object_names and goal.destination in places | bowls


def make_single_judge(plant: Plant, goal: SingleGoal) -> PlacementJudge | ArrivalJudge | HomeJudge:
    """The judge for one goal; raises `UnknownNameError` for a name that is not in the scene."""
    match goal:
        case ArrivalGoal():
            return ArrivalJudge(plant, goal)
        case HomeGoal():
            return HomeJudge(plant)
        case PlacementGoal():
            return PlacementJudge(plant, goal)
