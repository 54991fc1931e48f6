"""A scene under construction: random generator, objects so far, and the elements that scene families share."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from dualbrain.core.geometry.shapes import Bowl, Box, Cylinder, Quaternion, Shape, Vector
from dualbrain.records import Place
from dualbrain.simulation.scenes.scene_spec import MovingPerson, ObjectSpec

TABLE_PLACES = (
    Place("table_left", (0.36, 0.46, 0.0)),
    Place("table_right", (0.36, -0.46, 0.0)),
    Place("table_front", (0.68, 0.03, 0.0)),
)
PLACE_CLEARANCE = 0.11
CUBE = Box((0.02, 0.02, 0.025))
BOWL = Bowl(radius=0.085, height=0.05, wall=0.004)

HeightClass = Literal["flat", "low", "hand_high", "tall"]
"""Height relative to a grasp of the cube: up to the cube's height, below the hand, beside the hand, up to the wrist."""
HEIGHT_RANGES: dict[HeightClass, tuple[float, float]] = {
    "flat": (0.035, 0.050),
    "low": (0.045, 0.065),
    "hand_high": (0.08, 0.12),
    "tall": (0.15, 0.23),
}
GAP_RANGES: dict[HeightClass, tuple[float, float]] = {
    "flat": (0.04, 0.08),
    "low": (0.04, 0.08),
    "hand_high": (0.04, 0.08),
    "tall": (0.08, 0.11),
}
NARROW_GAP_RANGE = (0.02, 0.04)
OBJECT_COLOURS = ("green", "yellow", "orange", "purple", "teal", "white", "brown", "grey", "pink", "black")
CATEGORIES_BY_HEIGHT: dict[HeightClass, tuple[str, ...]] = {
    "flat": ("tin", "block"),
    "low": ("tin", "block"),
    "hand_high": ("can", "carton"),
    "tall": ("bottle", "box"),
}
ROUND_CATEGORIES = ("tin", "can", "bottle")


@dataclass(kw_only=True)
class SceneDraft:
    """Objects, person and places so far; methods draw from `rng` in a fixed order: a seed determines a scene."""

    rng: np.random.Generator
    seed: int
    objects: list[ObjectSpec] = field(default_factory=list)
    mover: MovingPerson | None = None
    places: tuple[Place, ...] = TABLE_PLACES

    # --- objects of the task ------------------------------------------------------------------------------------

    def add_task_objects(self) -> None:
        """Add the red cube on the right and the blue bowl on the left."""
        rng = self.rng
        x, y, yaw = 0.50 + rng.uniform(-0.02, 0.02), -0.22 + rng.uniform(-0.02, 0.02), rng.uniform(-0.25, 0.25)
        self.add_cube(x, y, yaw)
        self.add_bowl()

    def add_cube(self, x: float, y: float, yaw: float) -> None:
        """Add the red cube at (x, y) [m], turned by `yaw` [rad]."""
        at = (x, y, CUBE.half_extents[2])
        self.objects.append(
            ObjectSpec(
                name="red_cube",
                role="object",
                shape=CUBE,
                position=at,
                mass=0.08,
                colour="red",
                category="cube",
                quaternion=yaw_quaternion(yaw),
            )
        )

    def add_bowl(self) -> None:
        """Add the blue bowl at a random position on the left."""
        x, y = 0.50 + self.rng.uniform(-0.02, 0.02), 0.26 + self.rng.uniform(-0.02, 0.02)
        self.objects.append(
            ObjectSpec(
                name="blue_bowl",
                role="container",
                shape=BOWL,
                position=(x, y, 0.0),
                mass=0.35,
                colour="blue",
                category="bowl",
            )
        )

    # --- other objects ------------------------------------------------------------------------------------------

    def add_neighbour(self, height: HeightClass) -> None:
        """Add one object beside a random face of the cube, at a gap that still fits a hand."""
        face = int(self.rng.integers(4))
        narrow = height == "low" and self.rng.random() < 0.5
        lower, upper = NARROW_GAP_RANGE if narrow else GAP_RANGES[height]
        self.add_beside_cube(height, face, self.rng.uniform(lower, upper))

    def add_beside_cube(self, height: HeightClass, face: int, gap: float) -> None:
        """Add one object parallel to face number `face` of the cube (0: its local +x, 1: +y, …), at `gap` [m]."""
        cube = self.objects[0]
        yaw = 2.0 * float(np.arctan2(cube.quaternion[3], cube.quaternion[0])) + face * np.pi / 2
        shape, category = self._random_shape(height)
        distance = CUBE.half_extents[0] + gap + _half_extent_x(shape)
        x, y = cube.position[0] + distance * np.cos(yaw), cube.position[1] + distance * np.sin(yaw)
        self._add_object(shape, category, (x, y), yaw)

    def add_scattered(self, count: int, *heights: HeightClass) -> None:
        """Add `count` objects of random `heights` at free spots of the table."""
        for _ in range(count):
            self.add_within(self.random_height(*heights), x=(0.34, 0.70), y=(-0.36, 0.40), gap=0.06)

    def add_within(self, height: HeightClass, x: tuple[float, float], y: tuple[float, float], gap: float) -> None:
        """Add one object in the rectangle `x` × `y` [m], at least `gap` [m] from every other object."""
        shape, category = self._random_shape(height)
        at = self.find_free_spot(x, y, footprint_radius(shape), gap)
        self._add_object(shape, category, at, self.rng.uniform(-np.pi, np.pi))

    def add_fixed_box(
        self, name: str, half: tuple[float, float, float], centre: tuple[float, float, float], category: str
    ) -> None:
        """Add a fixed obstacle: a box with half extents `half` [m] around `centre` [m]."""
        (a, b, c), (x, y, z) = (map(float, values) for values in (half, centre))
        self.objects.append(
            ObjectSpec(
                name=name,
                role="obstacle",
                shape=Box((a, b, c)),
                position=(x, y, z),
                mass=1.0,
                colour="oak",
                category=category,
                fixed=True,
            )
        )

    # --- random choices -----------------------------------------------------------------------------------------

    def random_height(self, *heights: HeightClass) -> HeightClass:
        """One of `heights`, with equal probability."""
        return heights[int(self.rng.integers(len(heights)))]

    def find_free_spot(
        self, x: tuple[float, float], y: tuple[float, float], radius: float, gap: float
    ) -> tuple[float, float]:
        """A free spot (x, y) [m] in a rectangle, which grows slowly while it is full, so that every seed terminates."""
        for attempt in range(2000):
            grow = 1e-4 * attempt
            at = (self.rng.uniform(x[0] - grow, x[1] + grow), self.rng.uniform(y[0] - grow, y[1] + grow))
            if self.is_free(*at, radius, gap):
                return at
        return (x[0], y[0])

    def is_free(self, x: float, y: float, radius: float, gap: float) -> bool:
        """Whether a disc of `radius` at (x, y) keeps `gap` to every object and `PLACE_CLEARANCE` to every place [m]."""
        clear_of_objects = all(
            np.hypot(x - obj.position[0], y - obj.position[1]) > radius + footprint_radius(obj.shape) + gap
            for obj in self.objects
        )
        return clear_of_objects and all(
            np.hypot(x - place.position[0], y - place.position[1]) > radius + PLACE_CLEARANCE for place in self.places
        )

    def _new_name(self, category: str) -> tuple[str, str]:
        """An unused name of the form colour_category, and its colour."""
        used = {obj.name for obj in self.objects}
        free = [colour for colour in OBJECT_COLOURS if f"{colour}_{category}" not in used]
        colour = str(self.rng.choice(free))
        return f"{colour}_{category}", colour

    def _add_object(self, shape: Box | Cylinder, category: str, at: tuple[float, float], yaw: float) -> None:
        name, colour = self._new_name(category)
        half = shape.half_extents[2] if isinstance(shape, Box) else shape.half_height
        position: Vector = (float(at[0]), float(at[1]), float(half))
        mass = float(self.rng.uniform(0.12, 0.30))
        self.objects.append(
            ObjectSpec(
                name=name,
                role="object",
                shape=shape,
                position=position,
                mass=round(mass, 3),
                colour=colour,
                category=category,
                quaternion=yaw_quaternion(yaw),
            )
        )

    def _random_shape(self, height: HeightClass) -> tuple[Box | Cylinder, str]:
        category = str(self.rng.choice(list(CATEGORIES_BY_HEIGHT[height])))
        half = float(self.rng.uniform(*HEIGHT_RANGES[height])) / 2
        if category in ROUND_CATEGORIES:
            return Cylinder(float(self.rng.uniform(0.020, 0.028)), half), category
        return Box((float(self.rng.uniform(0.018, 0.026)), float(self.rng.uniform(0.018, 0.030)), half)), category


def footprint_radius(shape: Shape) -> float:
    """Radius [m] of the smallest circle around the footprint of an upright shape."""
    match shape:
        case Box(half_extents=(x, y, _)):
            return float(np.hypot(x, y))
        case Cylinder(radius=radius) | Bowl(radius=radius):
            return radius
        case _:
            return float(getattr(shape, "radius", 0.0))


def yaw_quaternion(yaw: float) -> Quaternion:
    """Quaternion (w, x, y, z) of a rotation by `yaw` [rad] about z."""
    return (float(np.cos(yaw / 2)), 0.0, 0.0, float(np.sin(yaw / 2)))


def _half_extent_x(shape: Box | Cylinder) -> float:
    """Half the extent [m] along local x, towards the cube."""
    return shape.half_extents[0] if isinstance(shape, Box) else footprint_radius(shape)
