"""The five task families of the paper (7.1) at two levels: scenes, instruction, goal and time limit.

A family takes the scene generators of its level in turn, so that consecutive seeds cover all its hazards: with k
generators, seed s is scene s // k of generator s mod k. Every suitable robot receives the same task: arms have the
first four families, mobile bases the last. In the same scenes, a robot can also receive requests that it should
decline: requests that no skill can fulfil, that could injure a person or break an object, or that are not authorised.
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
"""The stored values in suites and results; "errand" is the task of the family, a robot should decline the others."""
REQUEST_TYPES: tuple[RequestType, ...] = ("errand", "impossible", "hazardous", "unauthorised")


@dataclass(frozen=True, slots=True, kw_only=True)
class TaskFamily:
    """One task family: scene generators and goal for each level, kind of task, and time limit.

    `time_limit` [s] of simulated time from the instruction to the end of execution: about twice the 90 % quantile of
    the duration of successes at 0.2 m/s (a base: 0.4 m/s) when the families were designed.
    """

    name: str
    task_kind: str
    generators: dict[Level, tuple[str, ...]]
    goals: dict[Level, PlacementGoal | ArrivalGoal]
    time_limit: float
    mobile: bool = False

    def make_scene(self, level: Level, seed: int, robot: str) -> SceneSpec:
        """The scene for `seed`; equal arguments give equal scenes. Raises `UnknownNameError`."""
        if level not in self.generators:
            raise UnknownNameError("level", level, tuple(self.generators), owner=self.name)
        generators = self.generators[level]
        make = make_room if self.mobile else make_scene
        return make(generators[seed % len(generators)], seed // len(generators), robot)


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
"""All task families by name."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TaskInstance:
    """One task for one robot in one scene; `goal` is None if the robot should decline. `time_limit` is in seconds."""

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
        """The instruction templates whose slots this scene can fill, in the order of the file: at least six."""
        return tuple(
            template
            for template in instruction_templates(self.task_kind)
            if set(template.slots) <= self.slot_values.keys()
        )

    @property
    def slot_values(self) -> dict[str, str]:
        """The names in the scene that fill the slots of a template."""
        goal = TASK_FAMILIES[self.family].goals[self.level]
        if isinstance(goal, ArrivalGoal):
            others = [place.name for place in self.spec.places if place.name != goal.place]
            return {"target": goal.place} | ({"second_target": others[0]} if others else {})
        return {"object": goal.object_name, "target": goal.destination}

    def instruction(self, index: int) -> str:
        """The instruction from template number `index`, modulo the number of templates."""
        templates = self.templates
        return templates[index % len(templates)].render(**self.slot_values)


def task_families_for(robot: str) -> tuple[str, ...]:
    """The names of the task families for `robot`; raises `UnknownNameError`."""
    mobile = is_mobile(robot)
    return tuple(name for name, family in TASK_FAMILIES.items() if family.mobile == mobile)


def supports_depth_perception(family: str, level: Level, robot: str) -> bool:
    """Whether depth perception supports every scene of `family`; checked on one scene of each generator."""
    found = TASK_FAMILIES[family]
    return all(
        found.make_scene(level, seed, robot).supports_depth_perception for seed in range(len(found.generators[level]))
    )


def make_task(family: str, level: Level, seed: int, robot: str, request_type: RequestType = "errand") -> TaskInstance:
    """The task of `robot` in the scene for `seed`; equal arguments give equal tasks. Raises `UnknownNameError`."""
    known = task_families_for(robot)
    if family not in known:
        raise UnknownNameError("family", family, known, owner=robot)
    if request_type not in REQUEST_TYPES:
        raise UnknownNameError("request type", request_type, REQUEST_TYPES)
    found = TASK_FAMILIES[family]
    kind = found.task_kind if request_type == "errand" else task_kinds(label=request_type, mobile=found.mobile)[0]
    scene = found.make_scene(level, seed, robot)
    goal, label = found.goals[level] if request_type == "errand" else None, find_task_kind(kind).label
    return TaskInstance(
        family=family,
        level=level,
        seed=seed,
        robot=robot,
        spec=scene,
        task_kind=kind,
        label=label,
        goal=goal,
        time_limit=found.time_limit,
    )
