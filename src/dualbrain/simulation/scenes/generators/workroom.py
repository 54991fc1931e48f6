"""Generator of rooms for a mobile manipulator: a shelf, a charger, and a table at a wall with objects on it.

The robot starts at the origin with heading x. The places `shelf`, `charger` and `bench` are in front of shelf, charger
and table. On the table are a red cube, a blue bowl and, in the busy room, a can. The furniture is that of `rooms`; the
table is at the wall opposite the charger.
"""

from __future__ import annotations

import numpy as np

from dualbrain.core.geometry.shapes import Box, Cylinder
from dualbrain.errors import UnknownNameError
from dualbrain.records import Place
from dualbrain.simulation.scenes.generators.draft import BOWL, CUBE
from dualbrain.simulation.scenes.generators.rooms import ROOM_REGION, make_room
from dualbrain.simulation.scenes.scene_spec import ObjectSpec, SceneSpec, check_scene

TABLE_SHAPE = Box((0.55, 0.35, 0.25))
"""Table with its top at a height of 0.50 m, which is the mounting height of the arm on the base."""
BENCH_DISTANCE = 0.48
"""Distance between the edge of the table and its place [m]."""
CAN = Cylinder(0.03, 0.055)
OBJECT_DEPTH_RANGE = (0.12, 0.22)
"""Range of the distance between the edge of the table and the objects on it [m]."""


def make_workroom(family: str, seed: int, robot: str) -> SceneSpec:
    """The workroom of `family` for `seed`; equal arguments give equal rooms. Raises `UnknownNameError`."""
    if family not in WORKROOM_FAMILIES:
        raise UnknownNameError("room", family, WORKROOM_FAMILIES)
    rng = np.random.default_rng([seed, sum(map(ord, family))])
    room = make_room("empty_room", seed, robot)
    side = -1.0 if room.find_place("charger").position[1] > 0.0 else 1.0
    x, y = float(rng.uniform(1.2, 3.2)), side * (ROOM_REGION[2][1] - TABLE_SHAPE.half_extents[1])
    edge = y - side * TABLE_SHAPE.half_extents[1]
    table = ObjectSpec(
        name="table",
        role="support",
        shape=TABLE_SHAPE,
        position=(x, y, TABLE_SHAPE.half_extents[2]),
        mass=60.0,
        colour="oak",
        category="table",
        fixed=True,
    )
    spots = _random_spots(rng, x, edge, side, 3 if family == "busy_workroom" else 2)
    objects = [_object_on_table("red_cube", CUBE, spots[0], 0.1, "red", "cube", yaw=float(rng.uniform(-0.4, 0.4)))]
    objects.append(_bowl_on_table("blue_bowl", spots[1]))
    if family == "busy_workroom":
        objects.append(_object_on_table("green_can", CAN, spots[2], 0.2, "green", "can"))
    places = (*room.places, Place("bench", (x, edge - side * BENCH_DISTANCE, 0.0)))
    spec = SceneSpec(
        robot=robot,
        family=family,
        seed=seed,
        objects=(*room.objects, table, *objects),
        places=places,
        mover=None,
        region=ROOM_REGION,
    )
    check_scene(spec)
    return spec


WORKROOM_DESCRIPTIONS = {
    "workroom": "A room with shelf and charger, and a table with a red cube and a blue bowl.",
    "busy_workroom": "The workroom with a can beside the cube.",
}
WORKROOM_FAMILIES = tuple(WORKROOM_DESCRIPTIONS)


def _random_spots(
    rng: np.random.Generator, x: float, edge: float, side: float, count: int
) -> list[tuple[float, float]]:
    """Positions (x, y) [m] of `count` objects along the table, in random order, with room for a hand between them."""
    along = np.linspace(-0.24, 0.24, count) if count > 2 else np.array([-0.15, 0.15])
    along = rng.permutation(along) + rng.uniform(-0.02, 0.02, count)
    return [(x + float(a), edge + side * float(rng.uniform(*OBJECT_DEPTH_RANGE))) for a in along]


def _object_on_table(
    name: str, shape: Box | Cylinder, at: tuple[float, float], mass: float, colour: str, category: str, yaw: float = 0.0
) -> ObjectSpec:
    height = shape.half_extents[2] if isinstance(shape, Box) else shape.half_height
    turn = (float(np.cos(yaw / 2)), 0.0, 0.0, float(np.sin(yaw / 2)))
    top = 2.0 * TABLE_SHAPE.half_extents[2]
    return ObjectSpec(
        name=name,
        role="object",
        shape=shape,
        position=(at[0], at[1], top + height),
        mass=mass,
        colour=colour,
        category=category,
        quaternion=turn,
    )


def _bowl_on_table(name: str, at: tuple[float, float]) -> ObjectSpec:
    return ObjectSpec(
        name=name,
        role="container",
        shape=BOWL,
        position=(at[0], at[1], 2.0 * TABLE_SHAPE.half_extents[2]),
        mass=0.4,
        colour="blue",
        category="bowl",
    )
