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
from dualbrain.errors import InvalidSetup
from dualbrain.simulation.plant.plant import Plant
from dualbrain.simulation.scenes.scene_spec import SceneSpec, Thing
from dualbrain.simulation.tasks.arrival import Arrival, At
from dualbrain.simulation.tasks.placement import Goal, Referee, goal_of, inside, placed

RESTING, STILL = 0.05, 0.02
"""An arm is at home within this of each home angle [rad], slower than this [rad/s]."""
UNMOVED = 0.03
"""A thing that is nearer than this to where it was has not been moved [m]."""


class Home(msgspec.Struct, frozen=True):
    """Rest in the home posture."""


Single = Goal | At | Home


class Agenda(msgspec.Struct, frozen=True):
    """Goals by stage: every goal of a stage is reached no earlier than all of the stage before, and holds at the end.

    Of places that a base goes to, only the last has to hold at the end. Without stages: nothing is to be moved.
    """

    stages: tuple[tuple[Single, ...], ...]


def errand_of(words: str, spec: SceneSpec) -> Goal | At | Agenda:
    """What `words` demand in `spec`: one goal as `goal_of` reads it, or several.

    "A, then B"; "A and B" in any order, each with its verb; "put all the red things in Y", by colour or kind; "if Y is
    free, A, else B" (also empty, occupied, full; without else nothing is to be moved); "go home". Raises as `goal_of`.
    """
    said = words.strip().rstrip(".").lower()
    condition = re.fullmatch(
        r"if (?:the )?(.+?) is (free|empty|occupied|full),? (.+?)(?:,? (?:else|otherwise),? (.+))?", said
    )
    if condition:
        container, state, then, other = condition.groups()
        chosen = then if _free(container.replace(" ", "_"), spec) == (state in ("free", "empty")) else other
        return errand_of(chosen, spec) if chosen else Agenda(())
    stages = tuple(_stage(part, spec) for part in re.split(r"(?:, *|\b *and *|; *| +)then +", said))
    goals = [goal for stage in stages for goal in stage]
    return goals[0] if len(goals) == 1 and isinstance(goals[0], Goal | At) else Agenda(stages)


def _stage(words: str, spec: SceneSpec) -> tuple[Single, ...]:
    parts = re.split(r",? and (?=(?:put|place|move|go|drive)\b)", words.strip())
    return tuple(goal for part in parts for goal in _goals(part.strip(), spec))


def _goals(words: str, spec: SceneSpec) -> tuple[Single, ...]:
    if re.fullmatch(r"(?:go|return|drive) home", words):
        return (Home(),)
    every = re.fullmatch(
        r"(?:put|place|move) (?:all|every one)(?: of)?(?: the)? (.+?) (in|into|on|onto|to|at) (.+)", words
    )
    if every is None:
        return (goal_of(words, spec),)
    group, preposition, destination = every.groups()
    found = [thing for thing in spec.things if thing.role == "object" and _belongs(thing, group)]
    if not found:
        known = sorted(
            {word for thing in spec.things if thing.role == "object" for word in (thing.colour, thing.category)}
        )
        raise InvalidSetup("group of things", got=group, allowed=f"a colour or kind of things: {', '.join(known)}")
    return tuple(goal_of(f"put {thing.name} {preposition} {destination}", spec) for thing in found)


def _belongs(thing: Thing, group: str) -> bool:
    """Whether `group` ("red ones", "red things", "tins", "red tins") takes in `thing`."""
    asked = [word for word in group.split() if word not in ("ones", "things", "objects", "one", "thing", "object")]
    return bool(asked) and all(word.removesuffix("s") in (thing.colour, thing.category) for word in asked)


def _free(container: str, spec: SceneSpec) -> bool:
    """Whether nothing lies in `container`; raises `UnknownName`."""
    bowl = spec.find(container)
    if not isinstance(bowl.shape, Bowl):
        raise InvalidSetup("condition", got=container, allowed="a container that is free or occupied")
    others = (thing for thing in spec.things if thing.role == "object")
    return not any(inside(thing.position, bowl.position, bowl.shape) for thing in others)


class AgendaReferee:
    """Follows an agenda through an episode: call `watch` every 20 ms, then `judge`.

    So often, because a base hardly rests at a place that it only passes.
    """

    def __init__(self, plant: Plant, agenda: Agenda) -> None:
        """Remember where everything stands."""
        self._plant, self._agenda = plant, agenda
        self._referees = [[_referee(plant, goal) for goal in stage] for stage in agenda.stages]
        self._reached: dict[tuple[int, int], float] = {}
        self._free = [thing.name for thing in plant.spec.things if thing.role == "object" and not thing.fixed]
        self._rest = {name: np.array(plant.truth(name).position) for name in self._free}

    def watch(self) -> None:
        """Note which goals are reached by now, and when each was first."""
        for i, stage in enumerate(self._referees):
            for j, referee in enumerate(stage):
                referee.watch()
                goal = self._agenda.stages[i][j]
                near = not isinstance(goal, Goal) or placed(self._plant, goal)  # cheap: most moments are far from it
                if (i, j) not in self._reached and near and referee.judge()[0]:
                    self._reached[i, j] = self._plant.now

    def judge(self) -> tuple[bool, float]:
        """(success, progress) as of now; progress is the mean over all goals."""
        if not self._agenda.stages:
            still = all(
                np.linalg.norm(self._rest[name] - self._plant.truth(name).position) < UNMOVED for name in self._free
            )
            return still, float(still)
        self.watch()
        progress = [self._progress(i, j) for i, stage in enumerate(self._referees) for j in range(len(stage))]
        if all(one == 1.0 for one in progress) and self._in_order():
            return True, 1.0
        return False, min(0.99, float(np.mean(progress)))

    def _progress(self, i: int, j: int) -> float:
        """How far goal j of stage i is; a place that a base has passed stays reached unless it is the last."""
        success, progress = self._referees[i][j].judge()
        passed = isinstance(self._agenda.stages[i][j], At | Home) and i < len(self._agenda.stages) - 1
        return 1.0 if success or (passed and (i, j) in self._reached) else progress

    def _in_order(self) -> bool:
        times = [[self._reached[i, j] for j in range(len(stage))] for i, stage in enumerate(self._referees)]
        return all(max(before) <= min(after) for before, after in pairwise(times))


class Rested:
    """Whether the arm is in its home posture, wherever a base has carried it."""

    def __init__(self, plant: Plant) -> None:
        """Of this plant."""
        self._plant = plant

    def watch(self) -> None:
        """There are no stages on the way."""

    def judge(self) -> tuple[bool, float]:
        """(success, progress) as of now."""
        q = self._plant.data.qpos[self._plant.arm_slices[0]]
        there = float(np.max(np.abs(q - np.array(self._plant.body.home)[-len(q) :]))) < RESTING
        still = bool(np.all(np.abs(self._plant.speed()) < STILL))
        return there and still, float(there and still)


def _referee(plant: Plant, goal: Single) -> Referee | Arrival | Rested:
    match goal:
        case At():
            return Arrival(plant, goal)
        case Home():
            return Rested(plant)
        case Goal():
            return Referee(plant, goal)
