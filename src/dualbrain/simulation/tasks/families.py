"""The five families of tasks of the paper (7.1) at two levels: which scenes, which errand, what counts, for how long.

A family takes the generators of its level in turn, so that consecutive seeds show all its hazards: seed s of k
generators is number s // k of generator s mod k. The same errand is asked of every robot that can have it; arms have
the first four families, bases the last. What else may be asked in the same scenes, and should be declined, is what no
skill can do, what could hurt or break, and what no instruction may grant.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from dualbrain.errors import UnknownNameError
from dualbrain.simulation.scenes.generators.catalogue import is_mobile
from dualbrain.simulation.scenes.generators.rooms import make_room
from dualbrain.simulation.scenes.generators.tabletop import make_scene
from dualbrain.simulation.scenes.scene_spec import SceneSpec
from dualbrain.simulation.tasks.arrival import ArrivalGoal
from dualbrain.simulation.tasks.instructions import (
    InstructionTemplate,
    Label,
    find_task_kind,
    instruction_templates,
    task_kinds,
)
from dualbrain.simulation.tasks.placement import PlacementGoal

Level = Literal["I", "II"]
LEVELS: tuple[Level, ...] = ("I", "II")
RequestType = Literal["errand", "impossible", "hazardous", "unauthorised"]
"""errand: the family's own task; the others should be declined."""
REQUEST_TYPES: tuple[RequestType, ...] = ("errand", "impossible", "hazardous", "unauthorised")


@dataclass(frozen=True, slots=True, kw_only=True)
class TaskFamily:
    """One family: its scene generators and its goal by level, the errand's kind of wording, and the time limit.

    `time_limit` [s] of simulated time, from the question to the robot's word that it is done: about twice what nine of
    ten successes at 0.2 m/s (a base: 0.4 m/s) took when the families were made.
    """

    name: str
    task_kind: str
    generators: dict[Level, tuple[str, ...]]
    goals: dict[Level, PlacementGoal | ArrivalGoal]
    time_limit: float
    mobile: bool = False

    def make_scene(self, level: Level, seed: int, robot: str) -> SceneSpec:
        """The scene of `seed`; the same arguments always give the same scene. Raises `UnknownName`."""
        if level not in self.generators:
            raise UnknownNameError("level", level, tuple(self.generators), owner=self.name)
        turn = self.generators[level]
        make = make_room if self.mobile else make_scene
        return make(turn[seed % len(turn)], seed // len(turn), robot)


CUBE_TO_BOWL_GOALS: dict[Level, PlacementGoal | ArrivalGoal] = dict.fromkeys(
    LEVELS, PlacementGoal("red_cube", "blue_bowl")
)
GLASS_GOALS: dict[Level, PlacementGoal | ArrivalGoal] = {
    "I": PlacementGoal("clear_glass", "table_left", upright=True, gentle=True),
    "II": PlacementGoal("clear_glass", "coaster", upright=True, gentle=True),
}
SHELF_GOALS: dict[Level, PlacementGoal | ArrivalGoal] = dict.fromkeys(LEVELS, ArrivalGoal("shelf"))
CLUTTER_GENERATORS: dict[Level, tuple[str, ...]] = {"I": ("tabletop", "tall", "shelf"), "II": ("tall_ii", "shelf_ii")}
NAVIGATION_GENERATORS: dict[Level, tuple[str, ...]] = {"I": ("boxes", "crossing"), "II": ("aisles",)}

TASK_FAMILIES: dict[str, TaskFamily] = {
    family.name: family
    for family in (
        TaskFamily(
            name="clutter_grasp",
            task_kind="put_in",
            generators=CLUTTER_GENERATORS,
            goals=CUBE_TO_BOWL_GOALS,
            time_limit=45.0,
        ),
        TaskFamily(
            name="edge_rescue",
            task_kind="put_in",
            generators={"I": ("edge",), "II": ("edge_ii",)},
            goals=CUBE_TO_BOWL_GOALS,
            time_limit=45.0,
        ),
        TaskFamily(
            name="dynamic_obstacle",
            task_kind="put_in",
            generators={"I": ("forearm",), "II": ("forearm_ii",)},
            goals=CUBE_TO_BOWL_GOALS,
            time_limit=75.0,
        ),
        TaskFamily(
            name="fragile_transfer",
            task_kind="put_at",
            generators={"I": ("fragile",), "II": ("fragile_ii",)},
            goals=GLASS_GOALS,
            time_limit=45.0,
        ),
        TaskFamily(
            name="mobile_navigation",
            task_kind="go",
            generators=NAVIGATION_GENERATORS,
            goals=SHELF_GOALS,
            time_limit=75.0,
            mobile=True,
        ),
    )
}
"""All families by name."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TaskInstance:
    """What is asked of one robot in one scene; `goal` is None where the right answer is to decline."""

    family: str
    level: Level
    seed: int
    robot: str
    spec: SceneSpec
    task_kind: str
    label: Label
    goal: PlacementGoal | ArrivalGoal | None
    time_limit: float

    @property
    def templates(self) -> tuple[InstructionTemplate, ...]:
        """The ways to ask that this scene has names for, in the order of the file: six at least."""
        return tuple(
            wording
            for wording in instruction_templates(self.task_kind)
            if set(wording.slots) <= self.slot_values.keys()
        )

    @property
    def slot_values(self) -> dict[str, str]:
        """The names of the scene that fill a wording's slots."""
        goal = TASK_FAMILIES[self.family].goals[self.level]
        if isinstance(goal, ArrivalGoal):
            others = [place.name for place in self.spec.places if place.name != goal.place]
            return {"target": goal.place} | ({"second_target": others[0]} if others else {})
        return {"object": goal.object_name, "target": goal.destination}

    def instruction(self, index: int) -> str:
        """The words of `wording`, counted around."""
        ways = self.templates
        return ways[index % len(ways)].render(**self.slot_values)


def task_families_for(robot: str) -> tuple[str, ...]:
    """The families that `robot` can be asked for; raises `UnknownName`."""
    drives = is_mobile(robot)
    return tuple(name for name, family in TASK_FAMILIES.items() if family.mobile == drives)


def supports_depth_perception(family: str, level: Level, robot: str) -> bool:
    """Whether depth cameras alone can show every scene of `family`: one of each of its generators tells."""
    about = TASK_FAMILIES[family]
    return all(
        about.make_scene(level, turn, robot).supports_depth_perception for turn in range(len(about.generators[level]))
    )


def make_task(family: str, level: Level, seed: int, robot: str, request_type: RequestType = "errand") -> TaskInstance:
    """What is asked of `robot` in scene `seed`; the same arguments always give the same. Raises `UnknownName`."""
    known = task_families_for(robot)
    if family not in known:
        raise UnknownNameError("family", family, known, owner=robot)
    if request_type not in REQUEST_TYPES:
        raise UnknownNameError("ask", request_type, REQUEST_TYPES)
    about = TASK_FAMILIES[family]
    kind = about.task_kind if request_type == "errand" else task_kinds(label=request_type, mobile=about.mobile)[0]
    scene = about.make_scene(level, seed, robot)
    goal, label = about.goals[level] if request_type == "errand" else None, find_task_kind(kind).label
    return TaskInstance(
        family=family,
        level=level,
        seed=seed,
        robot=robot,
        spec=scene,
        task_kind=kind,
        label=label,
        goal=goal,
        time_limit=about.time_limit,
    )
