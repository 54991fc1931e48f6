"""Generator of table scenes by family and seed: objects, obstacles and a moving person.

All families share one task (a red cube on the right, a blue bowl on the left), so that they differ in the hazard.
Within a family, the seed varies the side, height and gap of the cube's neighbour, the shelf, and the phase of the
person, so that no fixed contract is best. Gaps of 2-4 cm occur only next to objects lower than the hand; all other gaps
are 4-8 cm. The families of this module are level I; those of level II are in `obstructed_tabletop` and `fragile`.
"""

from __future__ import annotations

from collections.abc import Callable

import msgspec
import numpy as np

from dualbrain.errors import UnknownNameError
from dualbrain.simulation.scenes.generators.draft import CUBE, SceneDraft, footprint_radius
from dualbrain.simulation.scenes.generators.fragile import FRAGILE_FAMILIES, GLASS
from dualbrain.simulation.scenes.generators.obstructed_tabletop import OBSTRUCTED_FAMILIES
from dualbrain.simulation.scenes.generators.sorting import sorting_scene
from dualbrain.simulation.scenes.scene_spec import (
    TABLE_X,
    TABLE_Y,
    MovingPerson,
    ObjectSpec,
    SceneSpec,
    check_scene,
    load_scene,
    save_scene,
)

__all__ = [
    "LEVEL_I_FAMILIES",
    "OBSTRUCTED_FAMILIES",
    "SCENE_FAMILIES",
    "SINGLE_GOAL_FAMILIES",
    "TABLE_X",
    "TABLE_Y",
    "MovingPerson",
    "ObjectSpec",
    "SceneSpec",
    "check_scene",
    "footprint_radius",
    "load_scene",
    "make_scene",
    "save_scene",
]


def make_scene(family: str, seed: int, robot: str = "panda") -> SceneSpec:
    """The scene of `family` for `seed` in front of `robot`; equal families and seeds give equal objects.

    Raises `UnknownNameError`.
    """
    if family not in SCENE_FAMILIES:
        raise UnknownNameError("scene family", family, tuple(SCENE_FAMILIES))
    draft = SceneDraft(rng=np.random.default_rng([seed, sum(map(ord, family))]), seed=seed)
    SCENE_FAMILIES[family](draft)
    spec = SceneSpec(
        robot=robot, family=family, seed=seed, objects=tuple(draft.objects), places=draft.places, mover=draft.mover
    )
    check_scene(spec)
    return spec


def _bare(draft: SceneDraft) -> None:
    """The table with nothing but the cube and the bowl."""
    draft.add_task_objects()


def _tabletop(draft: SceneDraft) -> None:
    """An ordinary table: one neighbour beside the cube and three to five more objects."""
    draft.add_task_objects()
    draft.add_neighbour(draft.random_height("low", "low", "hand_high"))
    draft.add_scattered(int(draft.rng.integers(3, 6)), "low", "hand_high")


def _tall(draft: SceneDraft) -> None:
    """Tall objects beside the cube and mostly also on the direct path to the bowl."""
    draft.add_task_objects()
    draft.add_neighbour("tall")
    for _ in range(int(draft.rng.choice([1, 2, 3]))):
        draft.add_within("tall", x=(0.42, 0.60), y=(-0.09, 0.12), gap=0.08)
    draft.add_scattered(1, "low", "hand_high")


def _shelf(draft: SceneDraft) -> None:
    """A board above the path to the bowl (missing in one of five scenes), with low objects below."""
    draft.add_task_objects()
    draft.add_neighbour(draft.random_height("low", "hand_high"))
    if draft.rng.random() < 0.8:
        _add_shelf(draft)
    draft.add_scattered(2, "low")


def _forearm(draft: SceneDraft) -> None:
    """A person's forearm moves across the path between cube and bowl, with a few other objects."""
    draft.add_task_objects()
    draft.add_neighbour(draft.random_height("low", "hand_high"))
    draft.add_scattered(int(draft.rng.integers(1, 4)), "low", "hand_high")
    draft.mover = _sweeping_forearm(draft.rng)


def _edge(draft: SceneDraft) -> None:
    """The cube overhangs the right edge of the table by 30-45 % of its width."""
    rng = draft.rng
    overhang = rng.uniform(0.30, 0.45)
    x, y = rng.uniform(0.28, 0.40), TABLE_Y[0] + 2 * CUBE.half_extents[1] * (0.5 - overhang)
    draft.add_cube(x, y, 0.0)
    draft.add_bowl()
    draft.add_scattered(int(rng.integers(2, 4)), "low", "hand_high")


def _fragile(draft: SceneDraft) -> None:
    """A thin glass that breaks above 15-25 N is near the path; it can also be the object of the task."""
    draft.add_task_objects()
    draft.add_neighbour(draft.random_height("low", "hand_high"))
    rng = draft.rng
    x, y = draft.find_free_spot((0.40, 0.58), (-0.10, 0.10), GLASS.radius, 0.06)
    glass = ObjectSpec(
        name="clear_glass",
        role="object",
        shape=GLASS,
        position=(x, y, GLASS.half_height),
        mass=0.08,
        colour="clear",
        category="glass",
        friction=0.8,
    )
    limit = round(float(rng.uniform(15.0, 25.0)), 1)
    draft.objects.append(msgspec.structs.replace(glass, fragile_limit=limit))
    draft.add_scattered(int(rng.integers(1, 3)), "low")


LEVEL_I_FAMILIES: dict[str, Callable[[SceneDraft], None]] = {
    "bare": _bare,
    "tabletop": _tabletop,
    "tall": _tall,
    "shelf": _shelf,
    "forearm": _forearm,
    "edge": _edge,
    "fragile": _fragile,
}
"""Scene families of level I, by name."""
SINGLE_GOAL_FAMILIES = {**LEVEL_I_FAMILIES, **OBSTRUCTED_FAMILIES, **FRAGILE_FAMILIES}
SCENE_FAMILIES = {**SINGLE_GOAL_FAMILIES, "sorting": sorting_scene}
"""All families of tables: `SINGLE_GOAL_FAMILIES` and `sorting`, whose tasks have several goals."""


def _add_shelf(draft: SceneDraft) -> None:
    """Add a board on a post that extends from the far side over the path to the bowl, 40-50 cm above the table."""
    rng = draft.rng
    y, z, tip = rng.uniform(0.165, 0.20), rng.uniform(0.40, 0.50), rng.uniform(0.44, 0.52)
    end, thickness = 0.80, 0.01
    draft.add_fixed_box("shelf", ((end - tip) / 2, 0.03, thickness), ((tip + end) / 2, y, z), "shelf")
    draft.add_fixed_box(
        "shelf_post", (0.015, 0.03, (z - thickness) / 2), (end - 0.015, y, (z - thickness) / 2), "shelf"
    )


def _sweeping_forearm(rng: np.random.Generator) -> MovingPerson:
    """A forearm that crosses the table along y at a height of 17-22 cm, above the low objects, with a random phase."""
    tip, z, speed, pause = (
        rng.uniform(0.44, 0.50),
        rng.uniform(0.175, 0.22),
        rng.uniform(0.12, 0.18),
        rng.uniform(2.0, 4.0),
    )
    side = 0.60 if rng.random() < 0.5 else -0.60
    x = float(tip) + 0.25 + 0.045
    cycle = 2.0 * (float(pause) + 1.2 / float(speed))
    start, end = (x, side, float(z)), (x, -side, float(z))
    return MovingPerson(
        start=start, end=end, speed=float(speed), pause=float(pause), phase=float(rng.uniform(0.0, cycle))
    )
