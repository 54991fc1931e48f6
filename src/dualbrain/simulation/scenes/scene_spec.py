"""What a scene is made of: things with mass and friction, a person's forearm, places; seeded, saved as JSON.

A `SceneSpec` is simulator truth. The robot never reads it: it sees what `perception` makes of the running plant. World
frame: origin at the robot's base on the table top, z up, metres and kilograms.
"""

from __future__ import annotations

from math import cos, sin
from pathlib import Path

import msgspec

from dualbrain.core.geometry.shapes import IDENTITY_QUATERNION, Box, Pose, Quaternion, Shape, Vector
from dualbrain.errors import DECODE_ERRORS, ConfigurationError, UnknownNameError
from dualbrain.records import Place, Role, SceneObject

SCHEMA_VERSION = 1
TABLE_X, TABLE_Y = (-0.20, 0.95), (-0.65, 0.65)
KEEP_OUT_HALF_HEIGHT = 1.0
"""How high over the floor what a map closes is taken to reach, and how deep below [m]."""


class ObjectSpec(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """One thing: a free body of `mass` [kg], or part of the room when `fixed`.

    `position` [m] is the shape's centre (of a bowl: its bottom). `friction` is the sliding coefficient; rubber pads
    hold everything alike unless it is slippery (`scene_builder.SLIPPERY`). `fragile_limit` [N] is the normal contact
    force above which it breaks.
    """

    name: str
    role: Role
    shape: Shape
    position: Vector
    mass: float
    colour: str
    category: str
    quaternion: Quaternion = IDENTITY_QUATERNION
    friction: float = 0.9
    fragile_limit: float | None = None
    fixed: bool = False


class MovingPerson(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A person's forearm: a capsule that goes from `start` to `end` [m] and back, resting at both ends.

    It travels at `speed` [m/s], rests `pause` [s] at each end and at t = 0 is `phase` [s] into its cycle, which begins
    with the rest at `start`. The capsule's axis is `axis`, its centre follows the path; it weighs `mass` [kg] and
    pushes with at most `force` [N].
    """

    start: Vector
    end: Vector
    speed: float
    pause: float
    phase: float
    name: str = "forearm"
    radius: float = 0.045
    half_length: float = 0.25
    axis: Vector = (1.0, 0.0, 0.0)
    mass: float = 5.0
    force: float = 150.0


KEEP_OUT_CATEGORY = "keep_out"
"""Category of what a map closes, where it stands among the things of a scene."""


class KeepOutArea(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A rectangle of the floor that is kept out of: its `middle` (x, y) and `half` sides [m], turned by `yaw` [rad]."""

    name: str
    middle: tuple[float, float]
    half: tuple[float, float]
    yaw: float = 0.0


class FloorMap(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What a map says of a room: a base keeps to `floor` (a convex polygon, counter-clockwise) and out of `closed`."""

    floor: tuple[tuple[float, float], ...]
    closed: tuple[KeepOutArea, ...] = ()


class SceneSpec(msgspec.Struct, frozen=True, forbid_unknown_fields=True, rename={"objects": "things"}, kw_only=True):
    """Everything needed to build one world again, bit for bit.

    With a `region` (corners (x, y) [m] of a convex polygon, counter-clockwise) the world is a room with walls;
    without one it is a table. A `chart` is no part of that world: it is what a base is told of it beforehand.
    """

    robot: str
    family: str
    seed: int
    objects: tuple[ObjectSpec, ...]
    places: tuple[Place, ...]
    mover: MovingPerson | None = None
    region: tuple[tuple[float, float], ...] = ()
    schema_version: int = SCHEMA_VERSION
    chart: FloorMap | None = None

    @property
    def floor(self) -> tuple[tuple[float, float], ...]:
        """What a base may drive on: the map's floor, or without a map the whole room."""
        return self.chart.floor if self.chart else self.region

    @property
    def supports_depth_perception(self) -> bool:
        """Whether depth cameras alone can show it: a table without people, for they know no person and no room."""
        return self.mover is None and not self.region

    def find(self, name: str) -> ObjectSpec:
        """The thing called `name`; raises `UnknownName`."""
        for thing in self.objects:
            if thing.name == name:
                return thing
        raise UnknownNameError("thing", name, tuple(thing.name for thing in self.objects), owner=f"scene {self.family}")

    def find_place(self, name: str) -> Place:
        """The place called `name`; raises `UnknownName`."""
        for place in self.places:
            if place.name == name:
                return place
        raise UnknownNameError("place", name, tuple(place.name for place in self.places), owner=f"scene {self.family}")


def keep_out_objects(spec: SceneSpec, stamp: float) -> tuple[SceneObject, ...]:
    """What the map of `spec` closes, as things that stand there for good and are known exactly at `stamp` [s]."""
    return tuple(
        SceneObject(
            name=one.name,
            role="obstacle",
            shape=Box((*one.half, KEEP_OUT_HALF_HEIGHT)),
            pose=Pose((*one.middle, 0.0), (cos(0.5 * one.yaw), 0.0, 0.0, sin(0.5 * one.yaw))),
            stamp=stamp,
            category=KEEP_OUT_CATEGORY,
            colour="red",
        )
        for one in (spec.chart.closed if spec.chart else ())
    )


def save_scene(spec: SceneSpec, path: Path) -> None:
    """Write `spec` as indented JSON."""
    path.write_bytes(msgspec.json.format(msgspec.json.encode(spec), indent=2) + b"\n")


def load_scene(path: Path) -> SceneSpec:
    """Read a scene; raises `InvalidSetup` that says which field is wrong and what is allowed there."""
    try:
        spec = msgspec.json.decode(path.read_bytes(), type=SceneSpec)
    except OSError as error:
        raise ConfigurationError(
            "scene file", got=error.strerror, allowed="a readable JSON file", fix=str(path)
        ) from error
    except DECODE_ERRORS as error:
        raise ConfigurationError(
            "scene file", got=str(error), allowed=f"a scene of schema version {SCHEMA_VERSION}", fix=str(path)
        ) from error
    try:
        check_scene(spec)
    except ConfigurationError as error:
        raise ConfigurationError(error.what, got=error.got, allowed=error.allowed, fix=str(path)) from error
    return spec


def check_scene(spec: SceneSpec) -> None:
    """Refuse what cannot be simulated: another schema, repeated names, sizes or masses that are not positive."""
    if spec.schema_version != SCHEMA_VERSION:
        raise ConfigurationError("scene schema_version", got=spec.schema_version, allowed=str(SCHEMA_VERSION))
    built_in = ("floor",) if spec.region else ("table", "floor")
    names = [*(thing.name for thing in spec.objects), *(place.name for place in spec.places), *built_in]
    names += [spec.mover.name] if spec.mover else []
    names += [one.name for one in spec.chart.closed] if spec.chart else []
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise ConfigurationError("scene names", got=twice, allowed="each name once, and none called table or floor")
    if spec.chart is not None and (not spec.region or len(spec.chart.floor) < 3):
        raise ConfigurationError("chart of the scene", got=spec.chart.floor, allowed="3 corners or more, in a room")
    for thing in spec.objects:
        _check_object(thing)
    if spec.mover is not None:
        _check_moving_person(spec.mover)


def _check_object(thing: ObjectSpec) -> None:
    sizes = [value for value in msgspec.structs.astuple(thing.shape) if not isinstance(value, tuple)]
    sizes += [part for value in msgspec.structs.astuple(thing.shape) if isinstance(value, tuple) for part in value]
    if not sizes or min(sizes) <= 0.0:
        raise ConfigurationError(f"size of {thing.name}", got=sizes, allowed="a shape with sizes above 0 m")
    if thing.mass <= 0.0 or thing.friction <= 0.0:
        raise ConfigurationError(
            f"mass and friction of {thing.name}", got=(thing.mass, thing.friction), allowed="above 0 kg and above 0"
        )


def _check_moving_person(mover: MovingPerson) -> None:
    if min(mover.speed, mover.mass, mover.force, mover.radius, mover.half_length) <= 0.0 or mover.pause < 0.0:
        raise ConfigurationError(
            f"path of {mover.name}",
            got=(mover.speed, mover.mass, mover.force, mover.pause),
            allowed="speed, mass, force and sizes above 0, pause not below 0",
        )
