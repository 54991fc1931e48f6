"""Scene specification: objects with mass and friction, a moving person, places; generated from a seed, saved as JSON.

A `SceneSpec` is simulator ground truth. The robot never reads it: it receives the output of a perception model. World
frame: origin at the robot's base on the table top, z up; lengths in metres, masses in kilograms.
"""

from __future__ import annotations

from math import cos, sin
from pathlib import Path

import msgspec

from dualbrain.core.geometry.shapes import IDENTITY_QUATERNION, Box, Pose, Quaternion, Shape, Vector
from dualbrain.core.storage.atomic_files import write_atomically
from dualbrain.core.untrusted.bounded_file import FileRefusal, read_regular_file
from dualbrain.errors import DECODE_ERRORS, ConfigurationError, UnknownNameError
from dualbrain.records import Place, Role, SceneObject

MAX_FILE_BYTES = 16 << 20
SCHEMA_VERSION = 1
TABLE_X, TABLE_Y = (-0.20, 0.95), (-0.65, 0.65)
KEEP_OUT_HALF_HEIGHT = 1.0
"""Extent of a keep-out area above and below the floor [m]."""


class ObjectSpec(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """One object: a free body of `mass` [kg], or a part of the room if `fixed`.

    `position` [m] is the centre of the shape (of a bowl: the centre of its bottom). `friction` is the sliding
    coefficient; it affects a grip only below `scene_builder.SLIPPERY_FRICTION`, otherwise the finger pads determine the
    friction. `fragile_limit` [N] is the normal contact force above which the object breaks.
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
    """A moving person or forearm: a capsule that moves from `start` to `end` [m] and back, with a rest at both ends.

    It moves at `speed` [m/s] and rests `pause` [s] at each end. The cycle begins with the rest at `start`; at t = 0,
    `phase` [s] of the cycle have passed. The centre of the capsule follows the path; `axis` is the direction of its
    axis, `radius` and `half_length` are in metres. It weighs `mass` [kg] and pushes with at most `force` [N].
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
"""Category of the keep-out areas of a map among the objects of a scene."""


class KeepOutArea(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A keep-out rectangle of the floor: `middle` (x, y) and `half` sides [m], turned by `yaw` [rad]."""

    name: str
    middle: tuple[float, float]
    half: tuple[float, float]
    yaw: float = 0.0


class FloorMap(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The map of a room: a base stays inside `floor` (a convex polygon, counter-clockwise [m]) and outside `closed`."""

    floor: tuple[tuple[float, float], ...]
    closed: tuple[KeepOutArea, ...] = ()


class SceneSpec(msgspec.Struct, frozen=True, forbid_unknown_fields=True, rename={"objects": "things"}, kw_only=True):
    """The complete description of a simulated scene, from which it can be rebuilt bit for bit.

    With a `region` (corners (x, y) [m] of a convex polygon, counter-clockwise) the scene is a room with walls, without
    one a table. `chart` is not part of the simulated scene: it is the map that a base knows in advance.
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
        """The floor that a base may drive on: that of the map, or without a map the whole room."""
        return self.chart.floor if self.chart else self.region

    @property
    def supports_depth_perception(self) -> bool:
        """Whether `DepthPerception` can perceive the scene: a table without people."""
        return self.mover is None and not self.region

    def find(self, name: str) -> ObjectSpec:
        """The object called `name`; raises `UnknownNameError`."""
        for obj in self.objects:
            if obj.name == name:
                return obj
        raise UnknownNameError("object", name, tuple(obj.name for obj in self.objects), owner=f"scene {self.family}")

    def find_place(self, name: str) -> Place:
        """The place called `name`; raises `UnknownNameError`."""
        for place in self.places:
            if place.name == name:
                return place
        raise UnknownNameError("place", name, tuple(place.name for place in self.places), owner=f"scene {self.family}")


def keep_out_objects(spec: SceneSpec, stamp: float) -> tuple[SceneObject, ...]:
    """The keep-out areas of the map of `spec` as static obstacles without position error at time `stamp` [s]."""
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
    """Write `spec` as indented JSON. Raises `FileWriteError`."""
    write_atomically(path, msgspec.json.format(msgspec.json.encode(spec), indent=2) + b"\n")


def load_scene(path: Path) -> SceneSpec:
    """Read a scene file; raises `ConfigurationError`, which names the wrong field and its allowed values."""
    content = read_regular_file(path, MAX_FILE_BYTES)
    if isinstance(content, FileRefusal):
        sentence = f"The scene file cannot be read: {content.sentence}"
        raise ConfigurationError.stating(sentence, fix=f"Check the path: {path}")
    try:
        spec = msgspec.json.decode(content, type=SceneSpec)
    except DECODE_ERRORS as error:
        sentence = f"The scene file does not contain a scene of schema version {SCHEMA_VERSION}: {error}."
        raise ConfigurationError.stating(sentence, fix=f"Correct the file: {path}") from error
    try:
        check_scene(spec)
    except ConfigurationError as error:
        fix = f"Correct the file: {path}"
        raise ConfigurationError(error.what, got=error.got, allowed=error.allowed, fix=fix) from error
    return spec


def check_scene(spec: SceneSpec) -> None:
    """Raise `ConfigurationError` for a scene that cannot be simulated.

    Reasons are another schema version, repeated names, and sizes or masses that are not positive.
    """
    if spec.schema_version != SCHEMA_VERSION:
        raise ConfigurationError("scene schema_version", got=spec.schema_version, allowed=str(SCHEMA_VERSION))
    built_in = ("floor",) if spec.region else ("table", "floor")
    names = [*(obj.name for obj in spec.objects), *(place.name for place in spec.places), *built_in]
    names += [spec.mover.name] if spec.mover else []
    names += [one.name for one in spec.chart.closed] if spec.chart else []
    repeated = sorted({name for name in names if names.count(name) > 1})
    if repeated:
        allowed = f"every name once, and no object called {' or '.join(built_in)}"
        raise ConfigurationError("names in the scene", got=repeated, allowed=allowed)
    if spec.chart is not None and (not spec.region or len(spec.chart.floor) < 3):
        allowed = "a floor with 3 corners or more, in a scene with a region"
        raise ConfigurationError("chart of the scene", got=spec.chart.floor, allowed=allowed)
    for obj in spec.objects:
        _check_object(obj)
    if spec.mover is not None:
        _check_moving_person(spec.mover)


def _check_object(obj: ObjectSpec) -> None:
    sizes = [value for value in msgspec.structs.astuple(obj.shape) if not isinstance(value, tuple)]
    sizes += [part for value in msgspec.structs.astuple(obj.shape) if isinstance(value, tuple) for part in value]
    if not sizes or min(sizes) <= 0.0:
        raise ConfigurationError(f"size of {obj.name}", got=sizes, allowed="a shape with sizes above 0 m")
    if obj.mass <= 0.0 or obj.friction <= 0.0:
        raise ConfigurationError(
            f"mass and friction of {obj.name}", got=(obj.mass, obj.friction), allowed="above 0 kg and above 0"
        )


def _check_moving_person(mover: MovingPerson) -> None:
    if min(mover.speed, mover.mass, mover.force, mover.radius, mover.half_length) <= 0.0 or mover.pause < 0.0:
        raise ConfigurationError(
            f"path of {mover.name}",
            got=(mover.speed, mover.mass, mover.force, mover.pause),
            allowed="speed, mass, force and sizes above 0, pause of 0 or more",
        )
