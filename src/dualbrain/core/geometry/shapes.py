"""Shapes and poses. Each shape is centred on its pose, with its long axis along local z.

Lengths are in metres; quaternions are (w, x, y, z). Every type is frozen, and `msgspec.json.encode` encodes it to JSON.
"""

from __future__ import annotations

import msgspec

Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]
"""Unit quaternion (w, x, y, z)."""

IDENTITY_QUATERNION: Quaternion = (1.0, 0.0, 0.0, 0.0)


class Sphere(msgspec.Struct, frozen=True, tag_field="shape", tag="sphere"):
    """A sphere of `radius` [m]."""

    radius: float


class Capsule(msgspec.Struct, frozen=True, tag_field="shape", tag="capsule"):
    """All points within `radius` [m] of a segment of half length `half_length` [m] along local z."""

    radius: float
    half_length: float


class Cylinder(msgspec.Struct, frozen=True, tag_field="shape", tag="cylinder"):
    """A cylinder of `radius` and `half_height` [m] along local z."""

    radius: float
    half_height: float


class Box(msgspec.Struct, frozen=True, tag_field="shape", tag="box"):
    """A box with `half_extents` [m] along its local axes."""

    half_extents: Vector


class HalfSpace(msgspec.Struct, frozen=True, tag_field="shape", tag="half_space"):
    """Everything below the plane through the pose with normal local z (a table top, a wall)."""


class Bowl(msgspec.Struct, frozen=True, tag_field="shape", tag="bowl"):
    """An open round container: outer `radius`, rim `height` above its pose (its bottom), `wall` thickness [m]."""

    radius: float
    height: float
    wall: float


Shape = Sphere | Capsule | Cylinder | Box | HalfSpace | Bowl


class Pose(msgspec.Struct, frozen=True):
    """Pose of an object or frame: `position` [m] and unit `quaternion` (w, x, y, z)."""

    position: Vector
    quaternion: Quaternion = IDENTITY_QUATERNION


IDENTITY_POSE = Pose((0.0, 0.0, 0.0))
"""The pose of the reference frame."""
