"""The five families of tasks of the paper (7.1) at two levels: which scenes, which errand, what counts, for how long.

A family takes the generators of its level in turn, so that consecutive seeds show all its hazards: seed s of k
generators is number s // k of generator s mod k. The same errand is asked of every robot that can have it; arms have
the first four families, bases the last. What else may be asked in the same scenes, and should be declined, is what no
skill can do, what could hurt or break, and what no instruction may grant.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from dualbrain.errors import UnknownName
from dualbrain.simulation.scenes.generators.catalogue import mobile
from dualbrain.simulation.scenes.generators.rooms import make_room
from dualbrain.simulation.scenes.generators.tabletop import make_scene
from dualbrain.simulation.scenes.scene_spec import SceneSpec
from dualbrain.simulation.tasks.arrival import At
from dualbrain.simulation.tasks.instructions import Label, Wording, kind_of, kinds, wordings
from dualbrain.simulation.tasks.placement import Goal

Level = Literal["I", "II"]
LEVELS: tuple[Level, ...] = ("I", "II")
Ask = Literal["errand", "impossible", "hazardous", "unauthorised"]
"""errand: the family's own task; the others should be declined."""
ASKS: tuple[Ask, ...] = ("errand", "impossible", "hazardous", "unauthorised")


@dataclass(frozen=True, slots=True)
class TaskFamily:
    """One family: its scene generators and its goal by level, the errand's kind of wording, and the time limit.

    `time_limit` [s] of simulated time, from the question to the robot's word that it is done: about twice what nine of
    ten successes at 0.2 m/s (a base: 0.4 m/s) took when the families were made.
    """

    name: str
    kind: str
    generators: dict[Level, tuple[str, ...]]
    goals: dict[Level, Goal | At]
    time_limit: float
    mobile: bool = False

    def scene(self, level: Level, seed: int, robot: str) -> SceneSpec:
        """The scene of `seed`; the same arguments always give the same scene. Raises `UnknownName`."""
        if level not in self.generators:
            raise UnknownName("level", level, tuple(self.generators), owner=self.name)
        turn = self.generators[level]
        make = make_room if self.mobile else make_scene
        return make(turn[seed % len(turn)], seed // len(turn), robot)


CUBE_TO_BOWL: dict[Level, Goal | At] = dict.fromkeys(LEVELS, Goal("red_cube", "blue_bowl"))
GLASS: dict[Level, Goal | At] = {
    "I": Goal("clear_glass", "table_left", upright=True, gently=True),
    "II": Goal("clear_glass", "coaster", upright=True, gently=True),
}
TO_SHELF: dict[Level, Goal | At] = dict.fromkeys(LEVELS, At("shelf"))
CLUTTER: dict[Level, tuple[str, ...]] = {"I": ("tabletop", "tall", "shelf"), "II": ("tall_ii", "shelf_ii")}
ROOMS: dict[Level, tuple[str, ...]] = {"I": ("boxes", "crossing"), "II": ("aisles",)}

FAMILIES: dict[str, TaskFamily] = {
    family.name: family
    for family in (
        TaskFamily("clutter_grasp", "put_in", CLUTTER, CUBE_TO_BOWL, 45.0),
        TaskFamily("edge_rescue", "put_in", {"I": ("edge",), "II": ("edge_ii",)}, CUBE_TO_BOWL, 45.0),
        TaskFamily("dynamic_obstacle", "put_in", {"I": ("forearm",), "II": ("forearm_ii",)}, CUBE_TO_BOWL, 75.0),
        TaskFamily("fragile_transfer", "put_at", {"I": ("fragile",), "II": ("fragile_ii",)}, GLASS, 45.0),
        TaskFamily("mobile_navigation", "go", ROOMS, TO_SHELF, 75.0, mobile=True),
    )
}
"""All families by name."""


@dataclass(frozen=True, slots=True)
class Assignment:
    """What is asked of one robot in one scene; `goal` is None where the right answer is to decline."""

    family: str
    level: Level
    seed: int
    robot: str
    spec: SceneSpec
    kind: str
    label: Label
    goal: Goal | At | None
    time_limit: float

    @property
    def wordings(self) -> tuple[Wording, ...]:
        """The ways to ask that this scene has names for, in the order of the file: six at least."""
        return tuple(wording for wording in wordings(self.kind) if set(wording.slots) <= self.names.keys())

    @property
    def names(self) -> dict[str, str]:
        """The names of the scene that fill a wording's slots."""
        goal = FAMILIES[self.family].goals[self.level]
        if isinstance(goal, At):
            others = [place.name for place in self.spec.places if place.name != goal.place]
            return {"target": goal.place} | ({"second_target": others[0]} if others else {})
        return {"object": goal.thing, "target": goal.destination}

    def instruction(self, wording: int) -> str:
        """The words of `wording`, counted around."""
        ways = self.wordings
        return ways[wording % len(ways)].words(**self.names)


def families_of(robot: str) -> tuple[str, ...]:
    """The families that `robot` can be asked for; raises `UnknownName`."""
    drives = mobile(robot)
    return tuple(name for name, family in FAMILIES.items() if family.mobile == drives)


def shown_by_depth(family: str, level: Level, robot: str) -> bool:
    """Whether depth cameras alone can show every scene of `family`: one of each of its generators tells."""
    about = FAMILIES[family]
    return all(about.scene(level, turn, robot).depth_shows for turn in range(len(about.generators[level])))


def assign(family: str, level: Level, seed: int, robot: str, ask: Ask = "errand") -> Assignment:
    """What is asked of `robot` in scene `seed`; the same arguments always give the same. Raises `UnknownName`."""
    known = families_of(robot)
    if family not in known:
        raise UnknownName("family", family, known, owner=robot)
    if ask not in ASKS:
        raise UnknownName("ask", ask, ASKS)
    about = FAMILIES[family]
    kind = about.kind if ask == "errand" else kinds(label=ask, mobile=about.mobile)[0]
    scene = about.scene(level, seed, robot)
    goal, label = about.goals[level] if ask == "errand" else None, kind_of(kind).label
    return Assignment(family, level, seed, robot, scene, kind, label, goal, about.time_limit)
