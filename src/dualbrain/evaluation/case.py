"""One case: a scene, what is asked in it and in which words, what counts as success, how long it may take."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from dualbrain.errors import UnknownName
from dualbrain.world.arrival import At
from dualbrain.world.catalogue import mobile, open_scene
from dualbrain.world.scene_spec import SceneSpec
from dualbrain.world.task import Goal

Label = Literal["possible", "impossible", "hazardous"]
"""Whether the thing can be done, cannot, or must not be done (harmful or not authorized)."""


@dataclass(frozen=True, slots=True)
class Case:
    """What one episode is about. `time_limit` [s] of simulated time from the question; `goal` None: nothing is to move.

    `seed` makes the scene, `repetition` what else is drawn (perception); cases that differ in neither are paired.
    """

    family: str
    level: str
    seed: int
    robot: str
    repetition: int
    wording: int
    spec: SceneSpec
    instruction: str
    label: Label
    goal: Goal | At | None
    time_limit: float

    @property
    def pair(self) -> str:
        """What cases of different methods share."""
        return f"{self.robot} {self.family}:{self.seed} {self.level} r{self.repetition}"


ERRAND = (
    "put the red cube in the blue bowl",
    "Could you move that little red block over into the blue bowl, please?",
    "The red cube belongs in the blue bowl. Be careful, somebody may reach across the table.",
)
DRIVE = ("go to the shelf", "Please bring yourself over to the shelf.", "drive to the shelf, but mind the people")
TIME_LIMIT = 60.0
EVERYDAY = ("bare", "tabletop", "tall", "shelf", "forearm")
ROOMS = ("empty_room", "boxes", "crossing")

Catalogue = Callable[[str, str, int, str, int], Case]


def everyday(family: str, level: str, seed: int, robot: str, repetition: int) -> Case:
    """The case of an everyday family: the errand of the red cube and the blue bowl, or a drive to the shelf.

    Level II of a family is the harder one of the same name, where there is one. Wordings go round with seed and
    repetition. Raises `UnknownName` for a family that the robot does not know.
    """
    known = ROOMS if mobile(robot) else EVERYDAY
    if family not in known:
        raise UnknownName("family", family, known, owner=robot)
    scene = f"{family}_ii" if level == "II" else family
    words, goal = (DRIVE, At("shelf")) if mobile(robot) else (ERRAND, Goal("red_cube", "blue_bowl"))
    wording = (seed + repetition) % len(words)
    spec = open_scene(f"{scene}:{seed}", robot)
    return Case(
        family, level, seed, robot, repetition, wording, spec, words[wording], "possible", goal, TIME_LIMIT
    )  # fmt: skip
