"""Obstacles of the safety filter, and their construction from perceived scene objects."""

from __future__ import annotations

from collections.abc import Collection
from typing import cast

import msgspec

from dualbrain.core.geometry import validation
from dualbrain.core.geometry.distance import Solid, bounding_solid
from dualbrain.core.geometry.plain_values import is_plain_length, is_plain_motion, is_plain_pose, is_plain_size
from dualbrain.core.geometry.shapes import IDENTITY_POSE, Box, Capsule, HalfSpace, Pose, Sphere, Vector
from dualbrain.errors import GeometryError
from dualbrain.records import ZERO_VECTOR, Place, Scene, SceneObject
from dualbrain.safety.cbf.config import MAX_CARTESIAN_SPEED, MAX_GAIN, MIN_CARTESIAN_SPEED
from dualbrain.safety.cbf.rows import Rank

SOLIDS = (Sphere, Capsule, Box, HalfSpace)
"""Shapes that an obstacle of the filter may have."""
MAX_CLOCK_LEAD = 0.005
"""Time [s] by which a stamp may be in the future, for two clocks that are not exactly synchronous."""
MAX_REACTION, MAX_DECELERATION, MAX_APPROACH = 1e3, 1e6, 1e3
OTHERS = "others"
"""Name of the entry of `PersonLimits` for the persons that have no entry of their own."""
MAX_NEAR_DISTANCE = 100.0
"""Largest distance of a speed limit near a person [m]."""
MAX_CONTACT_SPEED = 10.0
"""Largest contact speed of a permit [m/s]."""


_LONG = validation.MAX_NAME_LENGTH


class SpeedAndSeparation(msgspec.Struct, frozen=True):
    """Speed and separation monitoring toward one person, by the formula of ISO/TS 15066 (not a certified function).

    d = v_h (T_r + T_s) + v T_r + v²/(2a), T_s = v/a, gives the speed v toward the person at distance d; the row is
    n'J u ≥ −v. `reaction` T_r [s] is the time until braking begins, `brake` a [m/s²] the deceleration along the row
    that the robot always has, `approach` v_h [m/s] the least assumed speed of the person (ISO 13855: 1.6).
    """

    reaction: float = 0.1
    brake: float = 2.0
    approach: float = 0.0

    def __post_init__(self) -> None:
        """Check the numbers; raises `GeometryError`."""
        validation.check_length("SpeedAndSeparation.reaction [s]", self.reaction, MAX_REACTION)
        validation.check_positive("SpeedAndSeparation.brake [m/s²]", self.brake, MAX_DECELERATION)
        validation.check_length("SpeedAndSeparation.approach [m/s]", self.approach, MAX_APPROACH)


class NearSpeed(msgspec.Struct, frozen=True):
    """Limit of the speed of the robot's parts near one person, for power and force limiting (`contact_speed`).

    A part within `distance` [m] of the person moves at most at `speed` [m/s], in any direction. Farther away the limit
    rises such that the part decelerates to `speed` with `brake` [m/s²] before it is within the distance, also if the
    person approaches at `approach` [m/s] or at the observed speed.
    """

    speed: float
    distance: float = 0.3
    brake: float = 1.0
    approach: float = 0.0

    def __post_init__(self) -> None:
        """Check the numbers; raises `GeometryError`."""
        validation.check_number("NearSpeed.speed [m/s]", self.speed, MIN_CARTESIAN_SPEED, MAX_CARTESIAN_SPEED)
        validation.check_length("NearSpeed.distance [m]", self.distance, MAX_NEAR_DISTANCE)
        validation.check_positive("NearSpeed.brake [m/s²]", self.brake, MAX_DECELERATION)
        validation.check_length("NearSpeed.approach [m/s]", self.approach, MAX_APPROACH)


class PersonLimits(msgspec.Struct, frozen=True, kw_only=True):
    """Speed limits near persons, by the name of the scene object; `OTHERS` is the entry of every other person.

    An entry under the name of a person replaces those of `OTHERS`. Without any, the obstacle barrier alone applies,
    also to the persons in `named` that have no entry.
    """

    separation: dict[str, SpeedAndSeparation] = {}
    near: dict[str, NearSpeed] = {}
    named: frozenset[str] = frozenset()

    def separation_of(self, name: str) -> SpeedAndSeparation | None:
        """The speed and separation monitoring of a person."""
        return self.separation.get(self._key(name))

    def near_of(self, name: str) -> NearSpeed | None:
        """The power and force limiting of a person."""
        return self.near.get(self._key(name))

    def _key(self, name: str) -> str:
        own = name in self.named or name in self.separation or name in self.near
        return name if own else OTHERS


class PlacedShape(msgspec.Struct, frozen=True):
    """A named `shape` at `pose`."""

    name: str
    shape: Solid
    pose: Pose = IDENTITY_POSE


class Obstacle(PlacedShape, frozen=True, kw_only=True):
    """An obstacle: `shape` at `pose`, moving at `velocity` [m/s].

    - `margin` [m] inflates the shape (position error). `velocity_error` [m/s] bounds the error of the velocity and
      increases the margin with the age of the observation.
    - `known`: the projection φ respects the obstacle. `static`: its observation does not become stale. An obstacle with
      a velocity or a velocity error moves, with or without `static`.
    - `rank` is the order of relaxation, `alpha` [1/s] replaces the gain of the filter.
    - `parts`: robot parts that keep away (groups, links, "held"); empty means all.
    - `separation` adds a limit of the speed toward the obstacle by distance, `near` a limit of the speed of the parts
      near it, for power and force limiting. `barrier` is the name of the barrier that the rows belong to.
    """

    velocity: Vector = ZERO_VECTOR
    margin: float = 0.0
    velocity_error: float = 0.0
    known: bool = False
    static: bool = True
    rank: Rank = Rank.OBSTACLE
    alpha: float | None = None
    parts: tuple[str, ...] = ()
    separation: SpeedAndSeparation | None = None
    barrier: str = "obstacle"
    near: NearSpeed | None = None

    @property
    def moves(self) -> bool:
        """Whether the observation becomes stale: the obstacle is not static, or has a velocity or an error of it."""
        return not self.static or any(self.velocity) or self.velocity_error > 0.0


def check_obstacles(obstacles: object, most: int) -> tuple[Obstacle, ...]:
    """`obstacles`, at most `most`, with all numbers within bounds, quaternions of length 1, and `static` as it is.

    Raises:
        GeometryError: a field is not usable; the error names the obstacle and the field.
    """
    if type(obstacles) in (tuple, list):  # the usual case
        given = cast("tuple[Obstacle, ...]", obstacles)
        if len(given) <= most and all(map(_is_plain, given)):
            return tuple(given)
    found = validation.check_sequence("obstacles", obstacles, most, of="obstacles")
    return tuple(
        obstacle if _is_plain(obstacle) else check_obstacle(obstacle, index) for index, obstacle in enumerate(found)
    )


def _is_plain(obstacle: object) -> bool:
    """Whether `check_obstacle` would return an equal obstacle; an alpha or parts are left to `check_obstacle`."""
    return (
        type(obstacle) is Obstacle
        and is_plain_pose(obstacle.pose)
        and is_plain_motion(obstacle.velocity, obstacle.velocity_error)
        and is_plain_length(obstacle.margin)
        and type(obstacle.static) is bool
        and not (obstacle.static and (obstacle.velocity_error or any(obstacle.velocity)))
        and type(obstacle.shape) in SOLIDS
        and is_plain_size(obstacle.shape)
        and type(obstacle.name) is type(obstacle.barrier) is str
        and len(obstacle.name) <= _LONG
        and len(obstacle.barrier) <= _LONG
        and type(obstacle.rank) is Rank
        and type(obstacle.known) is bool
        and obstacle.parts == ()
        and obstacle.alpha is obstacle.separation is obstacle.near is None
    )


def check_obstacle(obstacle: object, index: int = 0) -> Obstacle:
    """`obstacle`, number `index` of its table, if it is usable; raises `GeometryError`."""
    given = validation.check_instance(f"obstacle {index}", obstacle, Obstacle)
    name = validation.check_name(f"name of obstacle {index}", given.name)
    of = f"obstacle {name[:40]!r}"
    velocity = validation.check_velocity(f"velocity of {of}", given.velocity)
    error = validation.check_length(f"velocity_error of {of}", given.velocity_error, validation.MAX_SPEED)
    static = validation.check_flag(f"static of {of}", given.static)
    if given.alpha is not None:
        validation.check_positive(f"alpha of {of}", given.alpha, MAX_GAIN)
    if given.separation is not None:
        validation.check_instance(f"separation of {of}", given.separation, SpeedAndSeparation).__post_init__()
    if given.near is not None:
        validation.check_instance(f"near of {of}", given.near, NearSpeed).__post_init__()
    if type(given.rank) is not Rank:
        raise GeometryError(f"rank of {of}", got=given.rank, allowed="a Rank")
    parts = validation.check_sequence(f"parts of {of}", given.parts, validation.MAX_NAME_LENGTH, of="part names")
    return Obstacle(
        name=name,
        shape=cast("Solid", validation.check_shape(f"shape of {of}", given.shape, SOLIDS)),
        pose=validation.check_pose(f"pose of {of}", given.pose),
        velocity=velocity,
        margin=validation.check_length(f"margin of {of}", given.margin),
        velocity_error=error,
        known=validation.check_flag(f"known of {of}", given.known),
        static=static and not any(velocity) and error == 0.0,
        rank=given.rank,
        alpha=given.alpha,
        parts=tuple(validation.check_name(f"parts of {of}", part) for part in parts),
        separation=given.separation,
        near=given.near,
        barrier=validation.check_name(f"barrier of {of}", given.barrier),
    )


def obstacles_from_scene(
    scene: Scene,
    *,
    known: Collection[str],
    held: str | None,
    clearance: float = 0.0,
    persons: PersonLimits | None = None,
) -> tuple[Obstacle, ...]:
    """Obstacles for all scene objects except `held`, with the perception error plus `clearance` [m] as margin.

    Objects observed before the stamp of the scene are moved along their velocity, and their margin grows accordingly.
    `known` lists the objects that the projection φ respects. `persons` adds its limits to the persons.

    Raises:
        GeometryError: an object has a number, shape or pose that is not usable, a stamp after that of the scene, or the
            name of another object or of a place.
    """
    validation.check_length("clearance", clearance)
    usable = check_scene(scene)
    return tuple(
        obstacle_from_checked_object(obj, usable.stamp, known=obj.name in known, clearance=clearance, persons=persons)
        for obj in usable.objects
        if obj.name != held
    )


def check_scene(scene: object) -> Scene:
    """`scene` with all numbers within bounds and quaternions of length 1.

    Raises:
        GeometryError: a number, shape, pose or corner is not usable, an object has a stamp after that of the scene, or
            two objects or places have one name.
    """
    given = validation.check_instance("scene", scene, Scene)
    stamp = validation.check_stamp("stamp of the scene", given.stamp)
    for corner in given.region:
        validation.check_vector("corner of the region of the scene", (*corner, 0.0))
    if not all(_is_plain_object(obj, stamp) for obj in given.objects):  # the unusual case
        given = msgspec.structs.replace(given, objects=tuple(_check_scene_object(obj, stamp) for obj in given.objects))
    _check_names(given)
    return given


def _check_names(scene: Scene) -> None:
    """Each object and place has a name of its own: a held or permitted obstacle is found by its name."""
    names = [obj.name for obj in scene.objects]
    for place in scene.places:
        given = validation.check_instance("place of the scene", place, Place)
        names.append(validation.check_name("name of a place", given.name))
    if len(set(names)) < len(names):
        raise GeometryError(
            "names in the scene",
            got=sorted({name for name in names if names.count(name) > 1}),
            allowed="one object or place for each name",
            fix="Number the objects of one kind, such as cup_1 and cup_2.",
        )


def _is_plain_object(obj: object, scene_stamp: float) -> bool:
    """Whether `_check_scene_object` would return an equal object."""
    return (
        type(obj) is SceneObject
        and is_plain_pose(obj.pose)
        and is_plain_motion(obj.velocity, obj.velocity_error)
        and is_plain_length(obj.error)
        and is_plain_size(obj.shape)
        and type(obj.name) is str
        and len(obj.name) <= _LONG
        and type(obj.stamp) is float
        and -validation.MAX_STAMP <= obj.stamp <= validation.MAX_STAMP
        and obj.stamp <= scene_stamp + MAX_CLOCK_LEAD
    )


def _check_scene_object(obj: SceneObject, scene_stamp: float) -> SceneObject:
    checked = check_scene_object(obj)
    if checked.stamp > scene_stamp + MAX_CLOCK_LEAD:
        raise GeometryError(
            f"stamp of scene object {checked.name[:40]!r}",
            got=checked.stamp,
            allowed=f"at most {MAX_CLOCK_LEAD:g} s after the stamp of the scene, {scene_stamp:g} s",
            fix="Stamp the objects and their scene with one clock.",
        )
    return checked


def check_scene_object(obj: object) -> SceneObject:
    """`obj` with all numbers within bounds and a quaternion of length 1; raises `GeometryError`."""
    given = validation.check_instance("scene object", obj, SceneObject)
    of = f"scene object {validation.check_name('name of a scene object', given.name)[:40]!r}"
    return msgspec.structs.replace(
        given,
        shape=validation.check_shape(f"shape of {of}", given.shape),
        pose=validation.check_pose(f"pose of {of}", given.pose),
        velocity=validation.check_velocity(f"velocity of {of}", given.velocity),
        error=validation.check_length(f"error of {of}", given.error),
        velocity_error=validation.check_length(f"velocity_error of {of}", given.velocity_error, validation.MAX_SPEED),
        stamp=validation.check_stamp(f"stamp of {of}", given.stamp),
    )


def moves(obj: SceneObject) -> bool:
    """Whether a scene object moves, so that its observation becomes stale."""
    return obj.role == "person" or any(obj.velocity) or obj.velocity_error > 0.0


def obstacle_from_checked_object(
    obj: SceneObject, stamp: float, *, known: bool, clearance: float = 0.0, persons: PersonLimits | None = None
) -> Obstacle:
    """The obstacle of one object of a scene at `stamp` [s] that has passed `check_scene`."""
    age = max(0.0, stamp - obj.stamp)
    shape, pose = bounding_solid(obj.shape, obj.pose)
    x, y, z = (p + v * age for p, v in zip(pose.position, obj.velocity, strict=True))
    return Obstacle(
        name=obj.name,
        shape=shape,
        pose=Pose((x, y, z), pose.quaternion),
        velocity=obj.velocity,
        margin=obj.error + obj.velocity_error * age + clearance,
        velocity_error=obj.velocity_error,
        known=known,
        static=not moves(obj),
        rank=Rank.BODY if obj.role == "person" else Rank.OBSTACLE,
        separation=persons.separation_of(obj.name) if persons and obj.role == "person" else None,
        near=persons.near_of(obj.name) if persons and obj.role == "person" else None,
    )


class Contact(msgspec.Struct, frozen=True):
    """Permit for `robot_part` (a sphere group or link: "hand", "fingers", "held", "left_finger") to touch `obstacle`.

    The rows of these pairs become n'(J u − v_o) ≥ −max(`speed`, s(h)): at most `speed` [m/s] at contact, and before it
    at most the speed that the barrier would allow.
    """

    robot_part: str
    obstacle: str
    speed: float
