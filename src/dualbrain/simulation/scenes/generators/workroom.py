"""Seeded rooms for a mobile manipulator: a shelf, a charger, and a table at a wall with things on it.

The robot starts at the origin and looks along x. In front of shelf, charger and table lie the places `shelf`, `charger`
and `bench`; on the table stand a red cube, a blue bowl and, in the busy room, a can beside them. The furniture is
that of `rooms`; the table stands at the wall opposite the charger.
"""

from __future__ import annotations

import numpy as np

from dualbrain.core.geometry.shapes import Box, Cylinder
from dualbrain.errors import UnknownName
from dualbrain.records import Place
from dualbrain.simulation.scenes.generators.draft import BOWL, CUBE
from dualbrain.simulation.scenes.generators.rooms import REGION, make_room
from dualbrain.simulation.scenes.scene_spec import SceneSpec, Thing, check_scene

TABLE = Box((0.55, 0.35, 0.25))
"""Its top is 0.50 m high, as high as the carrier's arm is mounted."""
BEFORE = 0.48
"""How far from the table's edge its place lies [m]."""
CAN = Cylinder(0.03, 0.055)
DEPTH = (0.12, 0.22)
"""How far behind the table's edge things stand [m]."""


def make_workroom(family: str, seed: int, robot: str) -> SceneSpec:
    """The workroom of `family` for `seed`; the same pair always gives the same room. Raises `UnknownName`."""
    if family not in WORKROOMS:
        raise UnknownName("room", family, WORKROOMS)
    rng = np.random.default_rng([seed, sum(map(ord, family))])
    room = make_room("empty_room", seed, robot)
    side = -1.0 if room.place("charger").position[1] > 0.0 else 1.0
    x, y = float(rng.uniform(1.2, 3.2)), side * (REGION[2][1] - TABLE.half_extents[1])
    edge = y - side * TABLE.half_extents[1]
    table = Thing("table", "support", TABLE, (x, y, TABLE.half_extents[2]), 60.0, "oak", "table", fixed=True)
    spots = _spots(rng, x, edge, side, 3 if family == "busy_workroom" else 2)
    things = [_on("red_cube", CUBE, spots[0], 0.1, "red", "cube", yaw=float(rng.uniform(-0.4, 0.4)))]
    things.append(_bowl("blue_bowl", spots[1]))
    if family == "busy_workroom":
        things.append(_on("green_can", CAN, spots[2], 0.2, "green", "can"))
    places = (*room.places, Place("bench", (x, edge - side * BEFORE, 0.0)))
    spec = SceneSpec(robot, family, seed, (*room.things, table, *things), places, None, REGION)
    check_scene(spec)
    return spec


WORKROOMS = ("workroom", "busy_workroom")


def _spots(rng: np.random.Generator, x: float, edge: float, side: float, count: int) -> list[tuple[float, float]]:
    """Where things stand along the table, in a shuffled order and a hand's breadth apart."""
    along = np.linspace(-0.24, 0.24, count) if count > 2 else np.array([-0.15, 0.15])
    along = rng.permutation(along) + rng.uniform(-0.02, 0.02, count)
    return [(x + float(a), edge + side * float(rng.uniform(*DEPTH))) for a in along]


def _on(
    name: str, shape: Box | Cylinder, at: tuple[float, float], mass: float, colour: str, category: str, yaw: float = 0.0
) -> Thing:  # fmt: skip
    height = shape.half_extents[2] if isinstance(shape, Box) else shape.half_height
    turn = (float(np.cos(yaw / 2)), 0.0, 0.0, float(np.sin(yaw / 2)))
    top = 2.0 * TABLE.half_extents[2]
    return Thing(name, "object", shape, (at[0], at[1], top + height), mass, colour, category, turn)


def _bowl(name: str, at: tuple[float, float]) -> Thing:
    return Thing(name, "container", BOWL, (at[0], at[1], 2.0 * TABLE.half_extents[2]), 0.4, "blue", "bowl")
