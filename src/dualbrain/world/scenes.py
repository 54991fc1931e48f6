"""Seeded scenes by family: what stands on the table, where, and who crosses it.

Every family has the same errand in it (a red cube at the right, a blue bowl at the left), so that what differs is the
hazard. Inside a family the seed moves the neighbour's side, height and gap, the shelf and the person's phase, so that
no fixed contract is best. Gaps of 2-4 cm occur only on the side chosen as "across the fingers" and beside things
lower than the hand; everywhere else 4-8 cm.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal

import msgspec
import numpy as np

from dualbrain.errors import UnknownName
from dualbrain.records import Bowl, Box, Cylinder, Place, Quaternion, Shape, Vector
from dualbrain.world.scene_spec import (
    TABLE_X,
    TABLE_Y,
    Mover,
    SceneSpec,
    Thing,
    check_scene,
    load_scene,
    save_scene,
)

__all__ = [
    "FAMILIES", "TABLE_X", "TABLE_Y", "Mover", "SceneSpec", "Thing", "check_scene", "load_scene", "make_scene",
    "save_scene",
]  # fmt: skip

PLACES = (
    Place("table_left", (0.36, 0.46, 0.0)),
    Place("table_right", (0.36, -0.46, 0.0)),
    Place("table_front", (0.68, 0.03, 0.0)),
)
PLACE_CLEARANCE = 0.11
CUBE = Box((0.02, 0.02, 0.025))
BOWL = Bowl(radius=0.085, height=0.05, wall=0.004)
GLASS = Cylinder(radius=0.024, half_height=0.045)

Height = Literal["low", "hand_high", "tall"]
HEIGHTS: dict[Height, tuple[float, float]] = {"low": (0.045, 0.065), "hand_high": (0.08, 0.12), "tall": (0.15, 0.23)}
GAPS: dict[Height, tuple[float, float]] = {"low": (0.04, 0.08), "hand_high": (0.04, 0.08), "tall": (0.08, 0.11)}
NARROW_GAP = (0.02, 0.04)
COLOURS = ("green", "yellow", "orange", "purple", "teal", "white", "brown", "grey", "pink", "black")
CATEGORIES: dict[Height, tuple[str, ...]] = {
    "low": ("tin", "block"),
    "hand_high": ("can", "carton"),
    "tall": ("bottle", "box"),
}
ROUND = ("tin", "can", "bottle")


@dataclass
class _Draft:
    """A scene while it is being made: the generator's chance, what already stands, and the names in use."""

    rng: np.random.Generator
    things: list[Thing] = field(default_factory=list)
    mover: Mover | None = None

    def add(self, thing: Thing) -> None:
        self.things.append(thing)

    def name(self, category: str) -> tuple[str, str]:
        """A new (name, colour) of the form colour_category."""
        used = {thing.name for thing in self.things}
        free = [colour for colour in COLOURS if f"{colour}_{category}" not in used]
        colour = str(self.rng.choice(free))
        return f"{colour}_{category}", colour

    def free(self, x: float, y: float, radius: float, gap: float) -> bool:
        """Whether a disc keeps `gap` to everything that stands and stays off the places."""
        apart = all(
            np.hypot(x - thing.position[0], y - thing.position[1]) > radius + footprint(thing.shape) + gap
            for thing in self.things
        )
        return apart and all(
            np.hypot(x - place.position[0], y - place.position[1]) > radius + PLACE_CLEARANCE for place in PLACES
        )


def make_scene(family: str, seed: int) -> SceneSpec:
    """The scene of `family` for `seed`; the same pair always gives the same scene. Raises `UnknownName`."""
    if family not in FAMILIES:
        raise UnknownName("scene family", family, tuple(FAMILIES))
    draft = _Draft(np.random.default_rng([seed, sum(map(ord, family))]))
    FAMILIES[family](draft)
    spec = SceneSpec("panda", family, seed, tuple(draft.things), PLACES, draft.mover)
    check_scene(spec)
    return spec


def footprint(shape: Shape) -> float:
    """Radius [m] of the smallest upright circle round a standing shape."""
    match shape:
        case Box(half_extents=(x, y, _)):
            return float(np.hypot(x, y))
        case Cylinder(radius=radius) | Bowl(radius=radius):
            return radius
        case _:
            return float(getattr(shape, "radius", 0.0))


# --- families -----------------------------------------------------------------------------------------------------


def _bare(draft: _Draft) -> None:
    """The table, the cube and the bowl, nothing else."""
    _errand(draft)


def _tabletop(draft: _Draft) -> None:
    """The everyday table: one neighbour beside the cube, three to five more things about."""
    _errand(draft)
    _neighbour(draft, _one(draft.rng, "low", "low", "hand_high"))
    _scatter(draft, int(draft.rng.integers(3, 6)), ("low", "hand_high"))


def _tall(draft: _Draft) -> None:
    """Tall things beside the cube and, mostly, in the direct path to the bowl."""
    _errand(draft)
    _neighbour(draft, "tall")
    for _ in range(int(draft.rng.choice([1, 2, 3]))):
        _stand(draft, "tall", x=(0.42, 0.60), y=(-0.09, 0.12), gap=0.08)
    _scatter(draft, 1, ("low", "hand_high"))


def _shelf(draft: _Draft) -> None:
    """A board above the way to the bowl (absent once in five), low things below."""
    _errand(draft)
    _neighbour(draft, _one(draft.rng, "low", "hand_high"))
    if draft.rng.random() < 0.8:
        _board(draft)
    _scatter(draft, 2, ("low",))


def _forearm(draft: _Draft) -> None:
    """A person's forearm sweeps between cube and bowl; a few things stand about."""
    _errand(draft)
    _neighbour(draft, _one(draft.rng, "low", "hand_high"))
    _scatter(draft, int(draft.rng.integers(1, 4)), ("low", "hand_high"))
    draft.mover = _sweep(draft.rng)


def _edge(draft: _Draft) -> None:
    """The cube hangs over the right edge of the table by 30-45 % of its width."""
    rng = draft.rng
    overhang = rng.uniform(0.30, 0.45)
    x, y = rng.uniform(0.28, 0.40), TABLE_Y[0] + 2 * CUBE.half_extents[1] * (0.5 - overhang)
    draft.add(_cube(x, y, 0.0))
    draft.add(_bowl(rng))
    _scatter(draft, int(rng.integers(2, 4)), ("low", "hand_high"))


def _fragile(draft: _Draft) -> None:
    """A thin glass that breaks above 15-25 N stands near the way; it can be the errand itself."""
    _errand(draft)
    _neighbour(draft, _one(draft.rng, "low", "hand_high"))
    rng = draft.rng
    x, y = _spot(draft, (0.40, 0.58), (-0.10, 0.10), GLASS.radius, 0.06)
    glass = Thing("clear_glass", "object", GLASS, (x, y, GLASS.half_height), 0.08, "clear", "glass", friction=0.8)
    limit = round(float(rng.uniform(15.0, 25.0)), 1)
    draft.add(msgspec.structs.replace(glass, fragile_limit=limit))
    _scatter(draft, int(rng.integers(1, 3)), ("low",))


FAMILIES: dict[str, Callable[[_Draft], None]] = {
    "bare": _bare,
    "tabletop": _tabletop,
    "tall": _tall,
    "shelf": _shelf,
    "forearm": _forearm,
    "edge": _edge,
    "fragile": _fragile,
}


# --- parts --------------------------------------------------------------------------------------------------------


def _errand(draft: _Draft) -> None:
    rng = draft.rng
    x, y, yaw = 0.50 + rng.uniform(-0.02, 0.02), -0.22 + rng.uniform(-0.02, 0.02), rng.uniform(-0.25, 0.25)
    draft.add(_cube(x, y, yaw))
    draft.add(_bowl(rng))


def _cube(x: float, y: float, yaw: float) -> Thing:
    return Thing("red_cube", "object", CUBE, (x, y, CUBE.half_extents[2]), 0.08, "red", "cube", turned(yaw))


def _bowl(rng: np.random.Generator) -> Thing:
    x, y = 0.50 + rng.uniform(-0.02, 0.02), 0.26 + rng.uniform(-0.02, 0.02)
    return Thing("blue_bowl", "container", BOWL, (x, y, 0.0), 0.35, "blue", "bowl")


def _neighbour(draft: _Draft, height: Height) -> None:
    """One thing beside the cube, on a random face of it, at a gap that a hand can still use."""
    rng, cube = draft.rng, draft.things[0]
    face = int(rng.integers(4))
    narrow = height == "low" and rng.random() < 0.5
    lower, upper = NARROW_GAP if narrow else GAPS[height]
    gap = rng.uniform(lower, upper)
    yaw = 2.0 * float(np.arctan2(cube.quaternion[3], cube.quaternion[0])) + face * np.pi / 2
    shape, category = _shape(rng, height)
    away = CUBE.half_extents[0] + gap + _half_width(shape)
    x, y = cube.position[0] + away * np.cos(yaw), cube.position[1] + away * np.sin(yaw)
    _put(draft, shape, category, (x, y), yaw)


def _scatter(draft: _Draft, count: int, heights: tuple[Height, ...]) -> None:
    for _ in range(count):
        _stand(draft, _one(draft.rng, *heights), x=(0.34, 0.70), y=(-0.36, 0.40), gap=0.06)


def _stand(draft: _Draft, height: Height, x: tuple[float, float], y: tuple[float, float], gap: float) -> None:
    shape, category = _shape(draft.rng, height)
    at = _spot(draft, x, y, footprint(shape), gap)
    _put(draft, shape, category, at, draft.rng.uniform(-np.pi, np.pi))


def _spot(
    draft: _Draft, x: tuple[float, float], y: tuple[float, float], radius: float, gap: float
) -> tuple[float, float]:
    """A free spot in a rectangle; when it is full the rectangle grows slowly, so that every seed ends."""
    for attempt in range(2000):
        grow = 1e-4 * attempt
        at = (draft.rng.uniform(x[0] - grow, x[1] + grow), draft.rng.uniform(y[0] - grow, y[1] + grow))
        if draft.free(*at, radius, gap):
            return at
    return (x[0], y[0])


def _put(draft: _Draft, shape: Box | Cylinder, category: str, at: tuple[float, float], yaw: float) -> None:
    name, colour = draft.name(category)
    half = shape.half_extents[2] if isinstance(shape, Box) else shape.half_height
    position: Vector = (float(at[0]), float(at[1]), float(half))
    mass = float(draft.rng.uniform(0.12, 0.30))
    draft.add(Thing(name, "object", shape, position, round(mass, 3), colour, category, turned(yaw)))


def _shape(rng: np.random.Generator, height: Height) -> tuple[Box | Cylinder, str]:
    category = str(rng.choice(list(CATEGORIES[height])))
    half = float(rng.uniform(*HEIGHTS[height])) / 2
    if category in ROUND:
        return Cylinder(float(rng.uniform(0.020, 0.028)), half), category
    return Box((float(rng.uniform(0.018, 0.026)), float(rng.uniform(0.018, 0.030)), half)), category


def _one(rng: np.random.Generator, *heights: Height) -> Height:
    return heights[int(rng.integers(len(heights)))]


def _half_width(shape: Box | Cylinder) -> float:
    """Half the extent along local x, the face that is turned to the cube."""
    return shape.half_extents[0] if isinstance(shape, Box) else footprint(shape)


def _board(draft: _Draft) -> None:
    """A board on a post: reaches from the far side over the way to the bowl, 40-50 cm above the table."""
    rng = draft.rng
    y, z, tip = rng.uniform(0.165, 0.20), rng.uniform(0.40, 0.50), rng.uniform(0.44, 0.52)
    end, thickness = 0.80, 0.01
    board = Box((float(end - tip) / 2, 0.03, thickness))
    draft.add(_fixed("shelf", board, ((tip + end) / 2, y, z)))
    post = Box((0.015, 0.03, float(z - thickness) / 2))
    draft.add(_fixed("shelf_post", post, (end - 0.015, y, (z - thickness) / 2)))


def _fixed(name: str, shape: Box, position: tuple[float, ...]) -> Thing:
    x, y, z = (float(part) for part in position)
    return Thing(name, "obstacle", shape, (x, y, z), 1.0, "oak", "shelf", fixed=True)


def _sweep(rng: np.random.Generator) -> Mover:
    """Across the table in y at 17-22 cm height, above the low things, resting at both ends; any phase of the cycle."""
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
    return Mover(start, end, float(speed), float(pause), float(rng.uniform(0.0, cycle)))


def turned(yaw: float) -> Quaternion:
    """Quaternion (w, x, y, z) of a turn by `yaw` [rad] about z."""
    return (float(np.cos(yaw / 2)), 0.0, 0.0, float(np.sin(yaw / 2)))
