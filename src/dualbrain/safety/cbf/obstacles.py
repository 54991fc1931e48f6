"""Obstacles as the kernel knows them, and how perceived things become obstacles."""

from __future__ import annotations

from collections.abc import Collection

import msgspec

from dualbrain.core.geometry.distance import Solid, bounding_solid
from dualbrain.core.geometry.shapes import IDENTITY_POSE, Pose, Vector
from dualbrain.records import ZERO_VECTOR, Scene, SceneObject
from dualbrain.safety.cbf.rows import Rank


class SpeedAndSeparation(msgspec.Struct, frozen=True):
    """Speed and separation toward one person, after the formula of ISO/TS 15066 (no certified function).

    d = v_h (T_r + T_s) + v T_r + v²/(2a), T_s = v/a, gives the speed v toward the person at distance d:
    n'J u ≥ −v. `reaction` T_r [s] is the time until braking begins, `brake` a [m/s²] the deceleration along the row
    that the robot always has, `approach` [m/s] the least speed v_h believed of the person (ISO 13855: 1.6).
    """

    reaction: float = 0.1
    brake: float = 2.0
    approach: float = 0.0


class PlacedShape(msgspec.Struct, frozen=True):
    """A named `shape` at `pose`."""

    name: str
    shape: Solid
    pose: Pose = IDENTITY_POSE


class Obstacle(PlacedShape, frozen=True, kw_only=True):
    """A thing to keep away from: `shape` at `pose`, moving at `velocity` [m/s].

    `margin` [m] inflates it (position error), `velocity_error` [m/s] bounds the error of the velocity and grows the
    margin with the age of the observation. `known` things are those φ respects by projection; `static` ones may be
    seen long ago. `rank` says what is given up last; `alpha` [1/s] replaces the filter's by a lesser one; only `parts`
    of the robot (groups, links, "held"; none: all) are kept away; `barrier` is the name of the barrier it belongs to.
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


def obstacles_from_scene(
    scene: Scene, *, known: Collection[str], held: str | None, clearance: float = 0.0
) -> tuple[Obstacle, ...]:
    """Every perceived thing but the `held` one, as obstacles with their errors as margins plus `clearance` [m].

    Things seen before the scene's stamp are carried forward along their velocity, their margin growing with it.
    """
    return tuple(
        _to_obstacle(thing, scene.stamp, thing.name in known, clearance)
        for thing in scene.objects
        if thing.name != held
    )


def _to_obstacle(obj: SceneObject, stamp: float, known: bool, clearance: float) -> Obstacle:
    age = max(0.0, stamp - obj.stamp)
    shape, pose = bounding_solid(obj.shape, obj.pose)
    x, y, z = (p + v * age for p, v in zip(pose.position, obj.velocity, strict=True))
    moves = obj.role == "person" or obj.velocity != ZERO_VECTOR or obj.velocity_error > 0.0
    return Obstacle(
        name=obj.name,
        shape=shape,
        pose=Pose((x, y, z), pose.quaternion),
        velocity=obj.velocity,
        margin=obj.error + obj.velocity_error * age + clearance,
        velocity_error=obj.velocity_error,
        known=known,
        static=not moves,
        rank=Rank.BODY if obj.role == "person" else Rank.OBSTACLE,
    )


class Contact(msgspec.Struct, frozen=True):
    """The sphere group or link `robot_part` ("hand", "fingers", "held", "left_finger") may meet `obstacle`.

    The barrier rows of exactly these pairs are replaced by n'(J u − v_o) ≥ −max(`speed`, α h): no faster than `speed`
    [m/s] at contact, and no faster than the barrier would allow before.
    """

    robot_part: str
    obstacle: str
    speed: float
