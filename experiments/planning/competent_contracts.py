"""Tasks with contracts as a competent planner would write them: the prompt's rules applied to the scene's symbols.

Nobody is asked; what the rules leave open (the errand, the speed) is drawn by seed.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from dualbrain.grounding.scene_summary import summarise_scene
from dualbrain.records import Scene
from dualbrain.simulation.perception.noisy_perception import NO_NOISE, NoisyPerception
from dualbrain.simulation.plant.plant import Plant
from dualbrain.simulation.scenes.generators.tabletop import LEVEL_I_FAMILIES, make_scene
from dualbrain.simulation.scenes.scene_spec import SceneSpec
from dualbrain.simulation.tasks.placement import PlacementGoal
from dualbrain.skills.kinematics.object_geometry import grasp_width, levelness
from experiments.safety.closed_loop import load_panda

SEEDS = range(100, 200)
"""Scenes that no other proof and no demonstration uses."""
TASK_KINDS = ("errand", "errand", "fetch", "errand", "pick", "errand", "fetch", "move_to")
"""Of eight tasks of a family: four cubes into the bowl, two other things to some place, a pick, a journey."""
SPEEDS = (0.1, 0.2, 0.3)
MAX_GRASP_WIDTH = 0.068
"""Things wider than this are not chosen: the fingers open to 80 mm [m]."""
CLEARANCE_BY_HEIGHT = {"none": 0.15, "low": 0.15, "hand_high": 0.2, "tall": 0.3}
"""Clearance by the greatest height on the way [m], as the prompt's rules have it."""
GRIP_FORCE = 12.0
"""Below the least force that breaks a glass [N]."""


@dataclass(frozen=True, slots=True)
class Task:
    """A scene, what is to be done in it, and the contract; `goal` is judged on truth where there is one."""

    spec: SceneSpec
    kind: str
    object_name: str
    actions: list[dict[str, Any]]
    goal: PlacementGoal | None


def task_parameters() -> Iterator[dict[str, Any]]:
    """Family, seed and kind of every task, in their fixed order: all families in turn, the kinds in rotation."""
    for count, seed in enumerate(SEEDS):
        for shift, family in enumerate(LEVEL_I_FAMILIES):
            yield {"family": family, "seed": seed, "kind": TASK_KINDS[(count + shift) % len(TASK_KINDS)]}


def make_task(family: str, seed: int, kind: str) -> Task:
    """The task: its errand and speed are drawn by seed, everything else follows from the scene."""
    spec = make_scene(family, seed)
    scene = NoisyPerception(spec, NO_NOISE, np.random.default_rng(seed)).perceive(Plant(spec, load_panda()))
    rng = np.random.default_rng([seed, sum(map(ord, family)), 11])
    speed = float(rng.choice(SPEEDS))
    if kind == "move_to":
        target = str(rng.choice([thing.name for thing in spec.objects if thing.role != "obstacle"]))
        move = {"target": target, "speed": speed, **_motion_parameters(scene, target)}
        return Task(spec, kind, target, [{"skill": "move_to", "params": move}], None)
    thing = str(rng.choice(_graspable_objects(scene))) if kind in ("fetch", "pick") else "red_cube"
    grasp = [{"skill": "grasp", "params": _grasp_parameters(scene, thing, speed)}]
    if kind == "pick":
        return Task(spec, kind, thing, [*grasp, {"skill": "hold", "params": {"duration": 1.0}}], None)
    destination = str(rng.choice([place.name for place in spec.places])) if kind == "fetch" else "blue_bowl"
    way = _motion_parameters(scene, thing, bowl=destination == "blue_bowl")
    place = {"destination": destination, "speed": speed, **way}
    goal = PlacementGoal(thing, destination)
    return Task(spec, kind, thing, [*grasp, {"skill": "place", "params": place}], goal)


def motion_and_grasp(scene: Scene, thing: str, speed: float = 0.2) -> tuple[dict[str, Any], dict[str, Any]]:
    """What the rules say of a journey with `thing` (clearance, route, wait), and of its grasp."""
    return _motion_parameters(scene, thing), _grasp_parameters(scene, thing, speed)


def _graspable_objects(scene: Scene) -> list[str]:
    """Things that the fingers can close on along the axis that the rules would choose."""
    objects = [thing for thing in scene.objects if thing.role == "object"]
    return [
        thing.name
        for thing in objects
        for axis in [_symbol_value(scene, thing.name, "free_finger_axis")]
        if grasp_width(thing, axis) < MAX_GRASP_WIDTH and levelness(thing, axis) > 0.9
    ]


def _grasp_parameters(scene: Scene, thing: str, speed: float) -> dict[str, Any]:
    words, way = _summary_line(scene, thing), _motion_parameters(scene, thing)
    return {
        "object": thing,
        "speed": speed,
        "clearance": way["clearance"],
        "finger_axis": _symbol_value(scene, thing, "free_finger_axis"),
        "opening": 0.08,
        "approach": "tilted" if "tight" in words else "top",
        "wait": way["wait"],
        "force": GRIP_FORCE,
    }


def _motion_parameters(scene: Scene, thing: str, *, bowl: bool = True) -> dict[str, Any]:
    """Clearance, route and wait; without a bowl as its end, a way may lead past anything that stands on the table."""
    lines = (
        [_summary_line(scene, thing)]
        if bowl
        else [_summary_line(scene, one.name) for one in scene.objects if one.role == "object"]
    )
    text = ", ".join(lines)
    crossing, overhead = "person: none" not in summarise_scene(scene), "overhead over_path" in text
    heights = [height for name, height in CLEARANCE_BY_HEIGHT.items() if f"path_max_height {name}" in text]
    clearance = max([0.2] * crossing + (heights or [CLEARANCE_BY_HEIGHT["none"]]))
    return {
        "clearance": 0.1 if overhead else clearance,
        "route": "near_base" if overhead else "direct",
        "wait": "until_clear" if crossing else "none",
    }


def _summary_line(scene: Scene, thing: str) -> str:
    """What the summary says of `thing`; nothing of containers."""
    start = f"{thing}: object"
    return next((line for line in summarise_scene(scene).splitlines() if line.startswith(start)), "")


def _symbol_value(scene: Scene, thing: str, name: str) -> str:
    """The word after `name` in the line of `thing`."""
    words = _summary_line(scene, thing).replace(",", "").split()
    return words[words.index(name) + 1]
