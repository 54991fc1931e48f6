"""Generator of rooms for a mobile base: walls, a shelf, a charger, boxes, parcels, and a person.

The base starts at the origin with heading x. The shelf is at the far wall, the charger at a side wall; the places in
front of them have their names. The gaps between boxes are wide enough for the base.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from dualbrain.core.geometry.shapes import Box, Vector
from dualbrain.errors import UnknownNameError
from dualbrain.records import Place
from dualbrain.simulation.scenes.scene_spec import MovingPerson, ObjectSpec, SceneSpec, check_scene

ROOM_REGION = ((-1.0, -2.4), (5.2, -2.4), (5.2, 2.4), (-1.0, 2.4))
SHELF, CHARGER = Box((0.2, 0.6, 0.9)), Box((0.25, 0.15, 0.3))
PLACE_DISTANCE = 0.65
"""Distance between the front of a piece of furniture and its place [m]."""
MIN_BOX_GAP = 0.95
"""Least gap between boxes, and around the start and the places [m]."""
CROSSING_X = 2.2
"""x of the path of a crossing person [m]; that strip is kept free of boxes."""


@dataclass(kw_only=True)
class _RoomDraft:
    rng: np.random.Generator
    objects: list[ObjectSpec] = field(default_factory=list)
    places: list[Place] = field(default_factory=list)
    mover: MovingPerson | None = None
    seed: int = 0

    def is_free(self, x: float, y: float, radius: float) -> bool:
        """Whether a disc of `radius` at (x, y) keeps `MIN_BOX_GAP` to the objects, the start and the places [m]."""
        spots = [(0.0, 0.0, 0.3), *((p.position[0], p.position[1], 0.3) for p in self.places)]
        spots += [(t.position[0], t.position[1], _box_radius(t)) for t in self.objects]
        return all(np.hypot(x - a, y - b) > radius + r + MIN_BOX_GAP for a, b, r in spots)


def make_room(family: str, seed: int, robot: str) -> SceneSpec:
    """The room of `family` for `seed`; equal arguments give equal rooms. Raises `UnknownNameError`."""
    if family not in ROOM_FAMILIES:
        raise UnknownNameError("room", family, tuple(ROOM_FAMILIES))
    draft = _RoomDraft(rng=np.random.default_rng([seed, sum(map(ord, family))]), seed=seed)
    _add_furniture(draft)
    ROOM_FAMILIES[family](draft)
    spec = SceneSpec(
        robot=robot,
        family=family,
        seed=seed,
        objects=tuple(draft.objects),
        places=tuple(draft.places),
        mover=draft.mover,
        region=ROOM_REGION,
    )
    check_scene(spec)
    return spec


def _empty(draft: _RoomDraft) -> None:
    """A room with nothing but the furniture."""
    del draft


def _boxes(draft: _RoomDraft) -> None:
    """Two to four boxes as obstacles."""
    for index in range(int(draft.rng.integers(2, 5))):
        _add_random_box(draft, index)


def _crossing(draft: _RoomDraft) -> None:
    """A person who walks across the room and back, and one or two boxes."""
    rng = draft.rng
    for index in range(int(rng.integers(1, 3))):
        _add_random_box(draft, index)
    y, speed, pause = float(rng.uniform(1.5, 1.8)), float(rng.uniform(0.15, 0.25)), float(rng.uniform(4.0, 7.0))
    cycle = 2.0 * (pause + 2.0 * y / speed)
    start: Vector = (CROSSING_X, y if rng.random() < 0.5 else -y, 0.9)
    end: Vector = (CROSSING_X, -start[1], 0.9)
    draft.mover = MovingPerson(
        start=start,
        end=end,
        speed=speed,
        pause=pause,
        phase=float(rng.uniform(0.0, cycle)),
        name="person",
        radius=0.25,
        half_length=0.62,
        axis=(0.0, 0.0, 1.0),
    )


def _aisles(draft: _RoomDraft) -> None:
    """A long rack with an aisle on either side, one of them narrow, and a person."""
    draft.objects.append(_fixed_box("long_rack", RACK, RACK_POSITION, "oak", "rack"))
    parcels, draft.mover = aisle_hazards(draft.rng, draft.seed, draft.places[0].position[1])
    draft.objects = [*draft.objects[:1], draft.objects[-1], *parcels]  # the shelf and the rack, without the charger
    draft.places = [draft.places[0], *AISLE_PLACES]


ROOM_FAMILIES: dict[str, Callable[[_RoomDraft], None]] = {
    "empty_room": _empty,
    "boxes": _boxes,
    "crossing": _crossing,
    "aisles": _aisles,
}


def _add_furniture(draft: _RoomDraft) -> None:
    rng = draft.rng
    y = float(rng.uniform(-1.3, 1.3))
    shelf_x = ROOM_REGION[1][0] - SHELF.half_extents[0]
    draft.objects.append(_fixed_box("shelf_unit", SHELF, (shelf_x, y), "oak", "shelf"))
    draft.places.append(Place("shelf", (shelf_x - SHELF.half_extents[0] - PLACE_DISTANCE, y, 0.0)))
    side, x = (1.0 if rng.random() < 0.5 else -1.0), float(rng.uniform(0.6, 2.6))
    charger_y = side * (ROOM_REGION[2][1] - CHARGER.half_extents[1])
    draft.objects.append(_fixed_box("charging_station", CHARGER, (x, charger_y), "teal", "charger"))
    draft.places.append(Place("charger", (x, charger_y - side * (CHARGER.half_extents[1] + PLACE_DISTANCE), 0.0)))


def _add_random_box(draft: _RoomDraft, index: int) -> None:
    """Add a box at a free spot, or none if no spot is found."""
    rng, half = draft.rng, float(draft.rng.uniform(0.15, 0.28))
    shape = Box((half, half, float(rng.uniform(0.2, 0.4))))
    for _ in range(400):
        x, y = float(rng.uniform(0.8, 4.2)), float(rng.uniform(-1.9, 1.9))
        if draft.is_free(x, y, half * 2**0.5) and abs(x - CROSSING_X) > 0.4 + half + 0.25:
            draft.objects.append(
                _fixed_box(f"crate_{index + 1}", shape, (x, y), "brown", "crate", float(rng.uniform(-3, 3)))
            )
            return


def _fixed_box(
    name: str, shape: Box, at: tuple[float, float], colour: str, category: str, yaw: float = 0.0
) -> ObjectSpec:
    turn = (float(np.cos(yaw / 2)), 0.0, 0.0, float(np.sin(yaw / 2)))
    return ObjectSpec(
        name=name,
        role="obstacle",
        shape=shape,
        position=(at[0], at[1], shape.half_extents[2]),
        mass=20.0,
        colour=colour,
        category=category,
        quaternion=turn,
        fixed=True,
    )


def _box_radius(obj: ObjectSpec) -> float:
    assert isinstance(obj.shape, Box)
    return float(np.hypot(obj.shape.half_extents[0], obj.shape.half_extents[1]))


RACK, RACK_POSITION = Box((1.0, 0.35, 0.8)), (2.0, 0.0)
"""Half extents and centre of the rack [m]."""
AISLE_CENTRE_Y = 1.28
"""Distance of the centre line of an aisle from the centre of the room [m]."""
AISLE_PLACES = (
    Place("aisle_left", (RACK_POSITION[0], AISLE_CENTRE_Y, 0.0)),
    Place("aisle_right", (RACK_POSITION[0], -AISLE_CENTRE_Y, 0.0)),
)
PARCEL_GAP_RANGE, PARCEL_GAP_OFFSET = (0.75, 0.79), 0.08
"""Width of the gap between two parcels, and its offset from the centre line of the aisle, first to one side and then to
the other [m]; the circumscribed circle of the base has a diameter of 0.61 m."""


def aisle_hazards(rng: np.random.Generator, seed: int, goal_y: float) -> tuple[list[ObjectSpec], MovingPerson]:
    """Parcels and person for `seed`; the shelf at y = `goal_y` [m] makes one of the aisles the shorter path.

    In turn: a person is in the shorter aisle for longer than a skill waits, and the other aisle is narrow; the shorter
    aisle is narrow and the other is free; the shorter aisle is narrow and a person is in the other for some time.
    """
    shorter = 1.0 if goal_y > 0.0 else -1.0
    narrow = -shorter if seed % 3 == 0 else shorter
    parcels = _random_parcels(rng, narrow)
    middle = (float(rng.uniform(1.6, 2.4)), -narrow * AISLE_CENTRE_Y)
    until = ((100.0, 130.0), (90.0, 120.0), (10.0, 18.0))[seed % 3]
    start = (-0.3, -1.95 * narrow) if seed % 3 == 1 else middle
    return parcels, _waiting_person(
        start, (-0.7, -1.9 * narrow), float(rng.uniform(0.35, 0.50)), float(rng.uniform(*until))
    )


def _random_parcels(rng: np.random.Generator, side: float) -> list[ObjectSpec]:
    """Two pairs of parcels in the aisle on `side` (1 left, -1 right), with offset gaps, so that the path bends."""
    found: list[ObjectSpec] = []
    bend = 1.0 if rng.random() < 0.5 else -1.0
    for colour, x, shift in (("brown", 1.40, bend), ("white", 2.60, -bend)):
        gap, centre = float(rng.uniform(*PARCEL_GAP_RANGE)), side * AISLE_CENTRE_Y + shift * PARCEL_GAP_OFFSET
        for number, direction in enumerate((1.0, -1.0), start=1):
            half = float(rng.uniform(0.12, 0.15))
            position = (x + float(rng.uniform(-0.05, 0.05)), centre + direction * (gap / 2 + half), half)
            name = f"{colour}_parcel_{number}"
            found.append(
                ObjectSpec(
                    name=name,
                    role="object",
                    shape=Box((half, half, half)),
                    position=position,
                    mass=4.0,
                    colour=colour,
                    category="parcel",
                )
            )
    return found


def _waiting_person(start: tuple[float, float], end: tuple[float, float], speed: float, until: float) -> MovingPerson:
    """An upright person who stays at `start` [m] until time `until` [s], then walks to `end` and back."""
    return MovingPerson(
        start=(*start, 0.9),
        end=(*end, 0.9),
        speed=speed,
        pause=until,
        phase=0.0,
        name="person",
        radius=0.25,
        half_length=0.62,
        axis=(0.0, 0.0, 1.0),
    )
