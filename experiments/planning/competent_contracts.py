"""Tasks with contracts as a competent planner would write them: the prompt's rules applied to the scene's symbols.

Nobody is asked; what the rules leave open (the errand, the speed) is drawn by seed.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from dualbrain.grounding.scene_summary import summarise
from dualbrain.records import Scene
from dualbrain.simulation.perception.noisy_perception import EXACT, Perception
from dualbrain.simulation.plant.plant import Plant
from dualbrain.simulation.scenes.generators.tabletop import FAMILIES, make_scene
from dualbrain.simulation.scenes.scene_spec import SceneSpec
from dualbrain.simulation.tasks.placement import Goal
from dualbrain.skills.kinematics.object_geometry import levelness, width
from experiments.safety.closed_loop import panda

SEEDS = range(100, 200)
"""Scenes that no other proof and no demonstration uses."""
KINDS = ("errand", "errand", "fetch", "errand", "pick", "errand", "fetch", "move_to")
"""Of eight tasks of a family: four cubes into the bowl, two other things to some place, a pick, a journey."""
SPEEDS = (0.1, 0.2, 0.3)
WIDEST = 0.068
"""Things wider than this are not chosen: the fingers open to 80 mm [m]."""
CLEARANCE = {"none": 0.15, "low": 0.15, "hand_high": 0.2, "tall": 0.3}
"""Clearance by the greatest height on the way [m], as the prompt's rules have it."""
FORCE = 12.0
"""Below the least force that breaks a glass [N]."""


@dataclass(frozen=True, slots=True)
class Task:
    """A scene, what is to be done in it, and the contract; `goal` is judged on truth where there is one."""

    spec: SceneSpec
    kind: str
    thing: str
    actions: list[dict[str, Any]]
    goal: Goal | None


def all_tasks() -> Iterator[dict[str, Any]]:
    """Family, seed and kind of every task, in their fixed order: all families in turn, the kinds in rotation."""
    for count, seed in enumerate(SEEDS):
        for shift, family in enumerate(FAMILIES):
            yield {"family": family, "seed": seed, "kind": KINDS[(count + shift) % len(KINDS)]}


def task(family: str, seed: int, kind: str) -> Task:
    """The task: its errand and speed are drawn by seed, everything else follows from the scene."""
    spec = make_scene(family, seed)
    scene = Perception(spec, EXACT, np.random.default_rng(seed)).look(Plant(spec, panda()))
    rng = np.random.default_rng([seed, sum(map(ord, family)), 11])
    speed = float(rng.choice(SPEEDS))
    if kind == "move_to":
        target = str(rng.choice([thing.name for thing in spec.things if thing.role != "obstacle"]))
        move = {"target": target, "speed": speed, **_way(scene, target)}
        return Task(spec, kind, target, [{"skill": "move_to", "params": move}], None)
    thing = str(rng.choice(_fitting(scene))) if kind in ("fetch", "pick") else "red_cube"
    grasp = [{"skill": "grasp", "params": _grasp(scene, thing, speed)}]
    if kind == "pick":
        return Task(spec, kind, thing, [*grasp, {"skill": "hold", "params": {"duration": 1.0}}], None)
    destination = str(rng.choice([place.name for place in spec.places])) if kind == "fetch" else "blue_bowl"
    way = _way(scene, thing, bowl=destination == "blue_bowl")
    place = {"destination": destination, "speed": speed, **way}
    goal = Goal(thing, destination)
    return Task(spec, kind, thing, [*grasp, {"skill": "place", "params": place}], goal)


def way_of(scene: Scene, thing: str, speed: float = 0.2) -> tuple[dict[str, Any], dict[str, Any]]:
    """What the rules say of a journey with `thing` (clearance, route, wait), and of its grasp."""
    return _way(scene, thing), _grasp(scene, thing, speed)


def _fitting(scene: Scene) -> list[str]:
    """Things that the fingers can close on along the axis that the rules would choose."""
    objects = [thing for thing in scene.objects if thing.role == "object"]
    return [
        thing.name
        for thing in objects
        for axis in [_symbol(scene, thing.name, "free_finger_axis")]
        if width(thing, axis) < WIDEST and levelness(thing, axis) > 0.9
    ]


def _grasp(scene: Scene, thing: str, speed: float) -> dict[str, Any]:
    words, way = _line(scene, thing), _way(scene, thing)
    return {
        "object": thing, "speed": speed, "clearance": way["clearance"],
        "finger_axis": _symbol(scene, thing, "free_finger_axis"), "opening": 0.08,
        "approach": "tilted" if "tight" in words else "top", "wait": way["wait"], "force": FORCE,
    }  # fmt: skip


def _way(scene: Scene, thing: str, *, bowl: bool = True) -> dict[str, Any]:
    """Clearance, route and wait; without a bowl as its end, a way may lead past anything that stands on the table."""
    lines = [_line(scene, thing)] if bowl else [_line(scene, one.name) for one in scene.objects if one.role == "object"]
    text = ", ".join(lines)
    crossing, overhead = "person: none" not in summarise(scene), "overhead over_path" in text
    heights = [height for name, height in CLEARANCE.items() if f"path_max_height {name}" in text]
    clearance = max([0.2] * crossing + (heights or [CLEARANCE["none"]]))
    return {
        "clearance": 0.1 if overhead else clearance, "route": "near_base" if overhead else "direct",
        "wait": "until_clear" if crossing else "none",
    }  # fmt: skip


def _line(scene: Scene, thing: str) -> str:
    """What the summary says of `thing`; nothing of containers."""
    start = f"{thing}: object"
    return next((line for line in summarise(scene).splitlines() if line.startswith(start)), "")


def _symbol(scene: Scene, thing: str, name: str) -> str:
    """The word after `name` in the line of `thing`."""
    words = _line(scene, thing).replace(",", "").split()
    return words[words.index(name) + 1]
