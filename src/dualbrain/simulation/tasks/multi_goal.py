"""Several goals in one errand: in order or in any, for all things of a colour or kind, on a condition of the scene.

An agenda is stages one after the other; the goals inside a stage may come in any order. Words become an agenda once, on
the scene as it is when the errand is given: "all the red things" are those that are there then, and a condition is
decided then. Judged on simulator truth, for evaluation only.
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
"""An arm is at home within this of each home angle [rad], slower than this [rad/s]."""
MAX_UNMOVED_DISTANCE = 0.03
"""A thing that is nearer than this to where it was has not been moved [m]."""


class HomeGoal(msgspec.Struct, frozen=True):
    """Rest in the home posture."""


SingleGoal = PlacementGoal | ArrivalGoal | HomeGoal


class GoalSequence(msgspec.Struct, frozen=True):
    """Goals by stage: every goal of a stage is reached no earlier than all of the stage before, and holds at the end.

    Of places that a base goes to, only the last has to hold at the end. Without stages: nothing is to be moved.
    """

    stages: tuple[tuple[SingleGoal, ...], ...]


def parse_goals(instruction: str, spec: SceneSpec) -> PlacementGoal | ArrivalGoal | GoalSequence:
    """What `words` demand in `spec`: one goal as `goal_of` reads it, or several.

    "A, then B"; "A and B" in any order, each with its verb; "put all the red things in Y", by colour or kind; "if Y is
    free, A, else B" (also empty, occupied, full; without else nothing is to be moved); "go home". Raises as `goal_of`.
    """
    said = instruction.strip().rstrip(".").lower()
    condition = re.fullmatch(
        r"if (?:the )?(.+?) is (free|empty|occupied|full),? (.+?)(?:,? (?:else|otherwise),? (.+))?", said
    )
    if condition:
        container, state, then, other = condition.groups()
        chosen = then if _is_empty(container.replace(" ", "_"), spec) == (state in ("free", "empty")) else other
        return parse_goals(chosen, spec) if chosen else GoalSequence(())
    stages = tuple(_parse_stage(part, spec) for part in re.split(r"(?:, *|\b *and *|; *| +)then +", said))
    goals = [goal for stage in stages for goal in stage]
    return goals[0] if len(goals) == 1 and isinstance(goals[0], PlacementGoal | ArrivalGoal) else GoalSequence(stages)


def _parse_stage(words: str, spec: SceneSpec) -> tuple[SingleGoal, ...]:
    parts = re.split(r",? and (?=(?:put|place|move|go|drive)\b)", words.strip())
    return tuple(goal for part in parts for goal in _parse_clause(part.strip(), spec))


def _parse_clause(words: str, spec: SceneSpec) -> tuple[SingleGoal, ...]:
    if re.fullmatch(r"(?:go|return|drive) home", words):
        return (HomeGoal(),)
    every = re.fullmatch(
        r"(?:put|place|move) (?:all|every one)(?: of)?(?: the)? (.+?) (in|into|on|onto|to|at) (.+)", words
    )
    if every is None:
        return (parse_goal(words, spec),)
    group, preposition, destination = every.groups()
    found = [thing for thing in spec.objects if thing.role == "object" and _is_in_group(thing, group)]
    if not found:
        known = sorted(
            {word for thing in spec.objects if thing.role == "object" for word in (thing.colour, thing.category)}
        )
        raise ConfigurationError(
            "group of things", got=group, allowed=f"a colour or kind of things: {', '.join(known)}"
        )
    return tuple(parse_goal(f"put {thing.name} {preposition} {destination}", spec) for thing in found)


def _is_in_group(thing: ObjectSpec, group: str) -> bool:
    """Whether `group` ("red ones", "red things", "tins", "red tins") takes in `thing`."""
    asked = [word for word in group.split() if word not in ("ones", "things", "objects", "one", "thing", "object")]
    return bool(asked) and all(word.removesuffix("s") in (thing.colour, thing.category) for word in asked)


def _is_empty(container: str, spec: SceneSpec) -> bool:
    """Whether nothing lies in `container`; raises `UnknownName`."""
    bowl = spec.find(container)
    if not isinstance(bowl.shape, Bowl):
        raise ConfigurationError("condition", got=container, allowed="a container that is free or occupied")
    others = (thing for thing in spec.objects if thing.role == "object")
    return not any(is_inside_bowl(thing.position, bowl.position, bowl.shape) for thing in others)


class GoalSequenceJudge:
    """Follows an agenda through an episode: call `watch` every 20 ms, then `judge`.

    So often, because a base hardly rests at a place that it only passes.
    """

    def __init__(self, plant: Plant, sequence: GoalSequence) -> None:
        """Remember where everything stands."""
        self._plant, self._sequence = plant, sequence
        self._judges = [[_make_judge(plant, goal) for goal in stage] for stage in sequence.stages]
        self._first_reached: dict[tuple[int, int], float] = {}
        self._free_objects = [thing.name for thing in plant.spec.objects if thing.role == "object" and not thing.fixed]
        self._start_positions = {name: np.array(plant.true_pose(name).position) for name in self._free_objects}

    def update(self) -> None:
        """Note which goals are reached by now, and when each was first."""
        for i, stage in enumerate(self._judges):
            for j, referee in enumerate(stage):
                referee.update()
                goal = self._sequence.stages[i][j]
                near = not isinstance(goal, PlacementGoal) or is_placed(
                    self._plant, goal
                )  # cheap: most moments are far from it
                if (i, j) not in self._first_reached and near and referee.score()[0]:
                    self._first_reached[i, j] = self._plant.now

    def score(self) -> tuple[bool, float]:
        """(success, progress) as of now; progress is the mean over all goals."""
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
        """How far goal j of stage i is; a place that a base has passed stays reached unless it is the last."""
        success, progress = self._judges[i][j].score()
        passed = isinstance(self._sequence.stages[i][j], ArrivalGoal | HomeGoal) and i < len(self._sequence.stages) - 1
        return 1.0 if success or (passed and (i, j) in self._first_reached) else progress

    def _is_in_order(self) -> bool:
        times = [[self._first_reached[i, j] for j in range(len(stage))] for i, stage in enumerate(self._judges)]
        return all(max(before) <= min(after) for before, after in pairwise(times))


class HomeJudge:
    """Whether the arm is in its home posture, wherever a base has carried it."""

    def __init__(self, plant: Plant) -> None:
        """Of this plant."""
        self._plant = plant

    def update(self) -> None:
        """There are no stages on the way."""

    def score(self) -> tuple[bool, float]:
        """(success, progress) as of now."""
        q = self._plant.data.qpos[self._plant.arm_slices[0]]
        there = float(np.max(np.abs(q - np.array(self._plant.robot_model.home)[-len(q) :]))) < HOME_TOLERANCE
        still = bool(np.all(np.abs(self._plant.robot_velocity()) < MAX_HOME_SPEED))
        return there and still, float(there and still)


def _make_judge(plant: Plant, goal: SingleGoal) -> PlacementJudge | ArrivalJudge | HomeJudge:
    match goal:
        case ArrivalGoal():
            return ArrivalJudge(plant, goal)
        case HomeGoal():
            return HomeJudge(plant)
        case PlacementGoal():
            return PlacementJudge(plant, goal)
