"""Tasks with contracts of a competent planner: the rules of the prompt applied to the scene's symbols.

No planner is involved; values that the rules leave open (the instruction, the speed) are drawn by seed.
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
"""Seeds of scenes that no other experiment and no demonstration uses."""
TASK_KINDS = ("errand", "errand", "fetch", "errand", "pick", "errand", "fetch", "move_to")
"""Of eight tasks of a family: four times the cube into the bowl, twice another object to a place, a pick, a motion."""
SPEEDS = (0.1, 0.2, 0.3)
MAX_GRASP_WIDTH = 0.068
"""Largest width of objects that are chosen [m]; the fingers open to 80 mm."""
CLEARANCE_BY_HEIGHT = {"none": 0.15, "low": 0.15, "hand_high": 0.2, "tall": 0.3}
"""Clearance by the greatest height on the path [m], by the rules of the prompt."""
GRIP_FORCE = 12.0
"""Grip force [N], below the smallest force that breaks a glass."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Task:
    """A scene, a task in it, and the contract; `goal`, if there is one, is judged on ground truth."""

    spec: SceneSpec
    kind: str
    object_name: str
    actions: list[dict[str, Any]]
    goal: PlacementGoal | None


def task_parameters() -> Iterator[dict[str, Any]]:
    """Family, seed and kind of every task, in their fixed order: all families in turn, kinds in rotation."""
    for count, seed in enumerate(SEEDS):
        for shift, family in enumerate(LEVEL_I_FAMILIES):
            yield {"family": family, "seed": seed, "kind": TASK_KINDS[(count + shift) % len(TASK_KINDS)]}


def make_task(family: str, seed: int, kind: str) -> Task:
    """A task: object, destination and speed are drawn by seed, everything else follows from the scene."""
    spec = make_scene(family, seed)
    scene = NoisyPerception(spec, NO_NOISE, np.random.default_rng(seed)).perceive(Plant(spec, load_panda()))
    rng = np.random.default_rng([seed, sum(map(ord, family)), 11])
    speed = float(rng.choice(SPEEDS))
    if kind == "move_to":
        target = str(rng.choice([one.name for one in spec.objects if one.role != "obstacle"]))
        move = {"target": target, "speed": speed, **_motion_parameters(scene, target)}
        return Task(spec=spec, kind=kind, object_name=target, actions=[{"skill": "move_to", "params": move}], goal=None)
    name = str(rng.choice(_graspable_objects(scene))) if kind in ("fetch", "pick") else "red_cube"
    grasp = [{"skill": "grasp", "params": _grasp_parameters(scene, name, speed)}]
    if kind == "pick":
        return Task(
            spec=spec,
            kind=kind,
            object_name=name,
            actions=[*grasp, {"skill": "hold", "params": {"duration": 1.0}}],
            goal=None,
        )
    destination = str(rng.choice([place.name for place in spec.places])) if kind == "fetch" else "blue_bowl"
    motion = _motion_parameters(scene, name, bowl=destination == "blue_bowl")
    place = {"destination": destination, "speed": speed, **motion}
    goal = PlacementGoal(name, destination)
    return Task(
        spec=spec, kind=kind, object_name=name, actions=[*grasp, {"skill": "place", "params": place}], goal=goal
    )


def motion_and_grasp(scene: Scene, name: str, speed: float = 0.2) -> tuple[dict[str, Any], dict[str, Any]]:
    """Parameters of a motion with the object `name` (clearance, route, wait) and of its grasp, by the rules."""
    return _motion_parameters(scene, name), _grasp_parameters(scene, name, speed)


def _graspable_objects(scene: Scene) -> list[str]:
    """Objects that the fingers can grasp along the axis that the rules choose."""
    objects = [one for one in scene.objects if one.role == "object"]
    return [
        one.name
        for one in objects
        for axis in [_symbol_value(scene, one.name, "free_finger_axis")]
        if grasp_width(one, axis) < MAX_GRASP_WIDTH and levelness(one, axis) > 0.9
    ]


def _grasp_parameters(scene: Scene, name: str, speed: float) -> dict[str, Any]:
    symbols, motion = _summary_line(scene, name), _motion_parameters(scene, name)
    return {
        "object": name,
        "speed": speed,
        "clearance": motion["clearance"],
        "finger_axis": _symbol_value(scene, name, "free_finger_axis"),
        "opening": 0.08,
        "approach": "tilted" if "tight" in symbols else "top",
        "wait": motion["wait"],
        "force": GRIP_FORCE,
    }


def _motion_parameters(scene: Scene, name: str, *, bowl: bool = True) -> dict[str, Any]:
    """Clearance, route and wait; unless the bowl is the destination, the path may pass any object on the table."""
    lines = (
        [_summary_line(scene, name)]
        if bowl
        else [_summary_line(scene, one.name) for one in scene.objects if one.role == "object"]
    )
    text = ", ".join(lines)
    crossing, overhead = "person: none" not in summarise_scene(scene), "overhead over_path" in text
    heights = [height for symbol, height in CLEARANCE_BY_HEIGHT.items() if f"path_max_height {symbol}" in text]
    clearance = max([0.2] * crossing + (heights or [CLEARANCE_BY_HEIGHT["none"]]))
    return {
        "clearance": 0.1 if overhead else clearance,
        "route": "near_base" if overhead else "direct",
        "wait": "until_clear" if crossing else "none",
    }


def _summary_line(scene: Scene, name: str) -> str:
    """The line of the scene summary about the object `name`; empty for containers."""
    start = f"{name}: object"
    return next((line for line in summarise_scene(scene).splitlines() if line.startswith(start)), "")


def _symbol_value(scene: Scene, name: str, symbol: str) -> str:
    """The word after `symbol` in the summary line of the object `name`."""
    words = _summary_line(scene, name).replace(",", "").split()
    return words[words.index(symbol) + 1]
