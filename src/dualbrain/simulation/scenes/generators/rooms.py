"""Seeded rooms for a base: walls, a shelf, a charger, boxes in the way, and a person who crosses.

The base starts at the origin and looks along x. The shelf stands at the far wall, the charger at a side wall; places
in front of them are named after them. Boxes leave gaps that the base can pass.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from dualbrain.core.geometry.shapes import Box, Vector
from dualbrain.errors import UnknownName
from dualbrain.records import Place
from dualbrain.simulation.scenes.scene_spec import Mover, SceneSpec, Thing, check_scene

REGION = ((-1.0, -2.4), (5.2, -2.4), (5.2, 2.4), (-1.0, 2.4))
SHELF, CHARGER = Box((0.2, 0.6, 0.9)), Box((0.25, 0.15, 0.3))
IN_FRONT = 0.65
"""How far from a thing's front its place lies [m]."""
GAP = 0.95
"""Room between boxes, and around the start and the places [m]."""
CROSSING = 2.2
"""Where the person crosses, x [m]; boxes stay off that strip."""


@dataclass
class _Draft:
    rng: np.random.Generator
    things: list[Thing] = field(default_factory=list)
    places: list[Place] = field(default_factory=list)
    mover: Mover | None = None
    seed: int = 0

    def free(self, x: float, y: float, radius: float) -> bool:
        """Whether a disc keeps its gap to everything that stands, to the start and to the places."""
        spots = [(0.0, 0.0, 0.3), *((p.position[0], p.position[1], 0.3) for p in self.places)]
        spots += [(t.position[0], t.position[1], _radius(t)) for t in self.things]
        return all(np.hypot(x - a, y - b) > radius + r + GAP for a, b, r in spots)


def make_room(family: str, seed: int, robot: str) -> SceneSpec:
    """The room of `family` for `seed`; the same pair always gives the same room. Raises `UnknownName`."""
    if family not in ROOMS:
        raise UnknownName("room", family, tuple(ROOMS))
    draft = _Draft(np.random.default_rng([seed, sum(map(ord, family))]), seed=seed)
    _furnish(draft)
    ROOMS[family](draft)
    spec = SceneSpec(robot, family, seed, tuple(draft.things), tuple(draft.places), draft.mover, REGION)
    check_scene(spec)
    return spec


def _empty(draft: _Draft) -> None:
    """Nothing but the furniture."""
    del draft


def _boxes(draft: _Draft) -> None:
    """Two to four boxes in the way."""
    for index in range(int(draft.rng.integers(2, 5))):
        _put_box(draft, index)


def _crossing(draft: _Draft) -> None:
    """A person who walks across the room and back, and a box or two."""
    rng = draft.rng
    for index in range(int(rng.integers(1, 3))):
        _put_box(draft, index)
    y, speed, pause = float(rng.uniform(1.5, 1.8)), float(rng.uniform(0.15, 0.25)), float(rng.uniform(4.0, 7.0))
    cycle = 2.0 * (pause + 2.0 * y / speed)
    start: Vector = (CROSSING, y if rng.random() < 0.5 else -y, 0.9)
    end: Vector = (CROSSING, -start[1], 0.9)
    draft.mover = Mover(
        start, end, speed, pause, float(rng.uniform(0.0, cycle)), name="person", radius=0.25, half_length=0.62,
        axis=(0.0, 0.0, 1.0),
    )  # fmt: skip


def _aisles(draft: _Draft) -> None:
    """A long rack with an aisle on either side, one of them narrow, and somebody about."""
    draft.things.append(_fixed("long_rack", RACK, RACK_AT, "oak", "rack"))
    parcels, draft.mover = hazards(draft.rng, draft.seed, draft.places[0].position[1])
    draft.things = [*draft.things[:1], draft.things[-1], *parcels]  # the shelf and the rack; no charger in an aisle
    draft.places = [draft.places[0], *AISLES]


ROOMS: dict[str, Callable[[_Draft], None]] = {
    "empty_room": _empty, "boxes": _boxes, "crossing": _crossing, "aisles": _aisles,
}  # fmt: skip


def _furnish(draft: _Draft) -> None:
    rng = draft.rng
    y = float(rng.uniform(-1.3, 1.3))
    shelf_x = REGION[1][0] - SHELF.half_extents[0]
    draft.things.append(_fixed("shelf_unit", SHELF, (shelf_x, y), "oak", "shelf"))
    draft.places.append(Place("shelf", (shelf_x - SHELF.half_extents[0] - IN_FRONT, y, 0.0)))
    side, x = (1.0 if rng.random() < 0.5 else -1.0), float(rng.uniform(0.6, 2.6))
    charger_y = side * (REGION[2][1] - CHARGER.half_extents[1])
    draft.things.append(_fixed("charging_station", CHARGER, (x, charger_y), "teal", "charger"))
    draft.places.append(Place("charger", (x, charger_y - side * (CHARGER.half_extents[1] + IN_FRONT), 0.0)))


def _put_box(draft: _Draft, index: int) -> None:
    """A box at a free spot; none where no spot is free."""
    rng, half = draft.rng, float(draft.rng.uniform(0.15, 0.28))
    shape = Box((half, half, float(rng.uniform(0.2, 0.4))))
    for _ in range(400):
        x, y = float(rng.uniform(0.8, 4.2)), float(rng.uniform(-1.9, 1.9))
        if draft.free(x, y, half * 2**0.5) and abs(x - CROSSING) > 0.4 + half + 0.25:
            draft.things.append(
                _fixed(f"crate_{index + 1}", shape, (x, y), "brown", "crate", float(rng.uniform(-3, 3)))
            )
            return


def _fixed(
    name: str, shape: Box, at: tuple[float, float], colour: str, category: str, yaw: float = 0.0
) -> Thing:  # fmt: skip
    turn = (float(np.cos(yaw / 2)), 0.0, 0.0, float(np.sin(yaw / 2)))
    return Thing(
        name, "obstacle", shape, (at[0], at[1], shape.half_extents[2]), 20.0, colour, category, turn, fixed=True
    )


def _radius(thing: Thing) -> float:
    assert isinstance(thing.shape, Box)
    return float(np.hypot(thing.shape.half_extents[0], thing.shape.half_extents[1]))


RACK, RACK_AT = Box((1.0, 0.35, 0.8)), (2.0, 0.0)
"""Half extents and middle of the rack [m]."""
MIDDLE = 1.28
"""Distance of an aisle's middle from the middle of the room [m]."""
AISLES = (Place("aisle_left", (RACK_AT[0], MIDDLE, 0.0)), Place("aisle_right", (RACK_AT[0], -MIDDLE, 0.0)))
PASSAGE, ASIDE = (0.75, 0.79), 0.08
"""Width of the way between two parcels, and how far it lies off the aisle's middle, to one side and then to the other
[m]; a circle around the base is 0.61 m wide."""


def hazards(rng: np.random.Generator, seed: int, goal_y: float) -> tuple[list[Thing], Mover]:
    """Parcels and person for `seed`, where the shelf stands at y = `goal_y` [m] and so makes one aisle the shorter.

    In turn: a person stays in the shorter aisle for longer than a skill waits, and the other is narrow; the shorter is
    narrow and the other free; the shorter is narrow and a person stays in the other for a while.
    """
    shorter = 1.0 if goal_y > 0.0 else -1.0
    narrow = -shorter if seed % 3 == 0 else shorter
    parcels = _parcels(rng, narrow)
    middle = (float(rng.uniform(1.6, 2.4)), -narrow * MIDDLE)
    until = ((100.0, 130.0), (90.0, 120.0), (10.0, 18.0))[seed % 3]
    start = (-0.3, -1.95 * narrow) if seed % 3 == 1 else middle
    return parcels, _person(start, (-0.7, -1.9 * narrow), float(rng.uniform(0.35, 0.50)), float(rng.uniform(*until)))


def _parcels(rng: np.random.Generator, side: float) -> list[Thing]:
    """Two pairs of parcels in the aisle on `side` (1 left, -1 right), each with a gap, so that the way bends."""
    found: list[Thing] = []
    bend = 1.0 if rng.random() < 0.5 else -1.0
    for colour, x, shift in (("brown", 1.40, bend), ("white", 2.60, -bend)):
        gap, centre = float(rng.uniform(*PASSAGE)), side * MIDDLE + shift * ASIDE
        for number, way in enumerate((1.0, -1.0), start=1):
            half = float(rng.uniform(0.12, 0.15))
            at = (x + float(rng.uniform(-0.05, 0.05)), centre + way * (gap / 2 + half), half)
            name = f"{colour}_parcel_{number}"
            found.append(Thing(name, "object", Box((half, half, half)), at, 4.0, colour, "parcel"))
    return found


def _person(start: tuple[float, float], end: tuple[float, float], speed: float, until: float) -> Mover:
    """An upright person who stands at `start` [m] until time `until` [s], then goes to `end` and back."""
    return Mover(
        (*start, 0.9), (*end, 0.9), speed, until, 0.0, name="person", radius=0.25, half_length=0.62,
        axis=(0.0, 0.0, 1.0),
    )  # fmt: skip
