"""Obstacles as the kernel knows them, and how perceived things become obstacles."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from math import hypot, pi, sqrt

import msgspec
import numpy as np

from dualbrain.linalg import matrix
from dualbrain.records import (
    STILL,
    Bowl,
    Box,
    Capsule,
    Cylinder,
    HalfSpace,
    Pose,
    Scene,
    SceneObject,
    Shape,
    Sphere,
    Vector,
)
from dualbrain.safety.rows import Rank

Solid = Sphere | Capsule | Box | HalfSpace
"""The shapes with an exact distance in the kernel."""


class Separation(msgspec.Struct, frozen=True):
    """Speed and separation toward one person, after the formula of ISO/TS 15066 (no certified function).

    d = v_h (T_r + T_s) + v T_r + v²/(2a), T_s = v/a, gives the speed v toward the person at distance d:
    n'J u ≥ −v. `reaction` T_r [s] is the time until braking begins, `brake` a [m/s²] the deceleration along the row
    that the robot always has, `approach` [m/s] the least speed v_h believed of the person (ISO 13855: 1.6).
    """

    reaction: float = 0.1
    brake: float = 2.0
    approach: float = 0.0


class Obstacle(msgspec.Struct, frozen=True):
    """A thing to keep away from: `shape` at `pose`, moving at `velocity` [m/s].

    `margin` [m] inflates it (position error), `velocity_error` [m/s] bounds the error of the velocity and grows the
    margin with the age of the observation. `known` things are those φ respects by projection; `static` ones may be
    seen long ago. `rank` says what is given up last; `alpha` [1/s] replaces the filter's; only `parts` of the robot
    (groups, links, "held"; none: all) are kept away; `barrier` is the name of the barrier it belongs to.
    """

    name: str
    shape: Solid
    pose: Pose
    velocity: Vector = STILL
    margin: float = 0.0
    velocity_error: float = 0.0
    known: bool = False
    static: bool = True
    rank: Rank = Rank.OBSTACLE
    alpha: float | None = None
    parts: tuple[str, ...] = ()
    separation: Separation | None = None
    barrier: str = "obstacle"


def from_scene(
    scene: Scene, *, known: Collection[str], held: str | None, clearance: float = 0.0
) -> tuple[Obstacle, ...]:
    """Every perceived thing but the `held` one, as obstacles with their errors as margins plus `clearance` [m].

    Things seen before the scene's stamp are carried forward along their velocity, their margin growing with it.
    """
    return tuple(
        _obstacle(thing, scene.stamp, thing.name in known, clearance) for thing in scene.objects if thing.name != held
    )


def _obstacle(thing: SceneObject, stamp: float, known: bool, clearance: float) -> Obstacle:
    age = max(0.0, stamp - thing.stamp)
    shape, pose = solid(thing.shape, thing.pose)
    x, y, z = (p + v * age for p, v in zip(pose.position, thing.velocity, strict=True))
    moves = thing.role == "person" or thing.velocity != STILL or thing.velocity_error > 0.0
    return Obstacle(
        name=thing.name,
        shape=shape,
        pose=Pose((x, y, z), pose.quaternion),
        velocity=thing.velocity,
        margin=thing.error + thing.velocity_error * age + clearance,
        velocity_error=thing.velocity_error,
        known=known,
        static=not moves,
        rank=Rank.BODY if thing.role == "person" else Rank.OBSTACLE,
    )


def solid(shape: Shape, pose: Pose) -> tuple[Solid, Pose]:
    """The smallest cover by a shape with an exact distance: cylinders by volume, bowls as a box of full height."""
    match shape:
        case Cylinder():
            return min(_covers(shape), key=_volume), pose
        case Bowl(radius=radius, height=height):
            x, y, z = matrix(pose.quaternion) @ np.array([0.0, 0.0, 0.5 * height]) + np.array(pose.position)
            return Box((radius, radius, 0.5 * height)), Pose((float(x), float(y), float(z)), pose.quaternion)
        case _:
            return shape, pose


def _covers(cylinder: Cylinder) -> Iterator[Solid]:
    """A box, a ball, and capsules whose caps reach the rim."""
    r, h = cylinder.radius, cylinder.half_height
    yield Box((r, r, h))
    yield Sphere(hypot(r, h))
    for share in (0.25, 0.5, 0.75, 1.0):
        yield Capsule(radius=sqrt(r * r + (h * (1.0 - share)) ** 2), half_length=share * h)


def _volume(shape: Solid) -> float:
    match shape:
        case Box(half_extents=(x, y, z)):
            return 8.0 * x * y * z
        case Sphere(radius=r):
            return 4.0 / 3.0 * pi * r**3
        case Capsule(radius=r, half_length=h):
            return 4.0 / 3.0 * pi * r**3 + 2.0 * pi * r * r * h
        case HalfSpace():
            return float("inf")
