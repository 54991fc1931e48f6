"""Signed distances of points to solids, and the cover of every perceived shape by a solid with an exact distance."""

from __future__ import annotations

from collections.abc import Iterator
from math import hypot, pi, sqrt

import numpy as np
from numpy.typing import NDArray

from dualbrain.core.geometry.rotations import quaternion_to_matrix
from dualbrain.core.geometry.shapes import Bowl, Box, Capsule, Cylinder, HalfSpace, Pose, Shape, Sphere

Array = NDArray[np.float64]

Solid = Sphere | Capsule | Box | HalfSpace
"""Shapes for which the kernel has an exact distance."""


def bounding_solid(shape: Shape, pose: Pose) -> tuple[Solid, Pose]:
    """A solid that contains `shape` at `pose`: for a cylinder the one of least volume, for a bowl a box of its height.

    Other shapes are returned unchanged.
    """
    match shape:
        case Cylinder():
            return min(_cylinder_covers(shape), key=_volume), pose
        case Bowl(radius=radius, height=height):
            x, y, z = quaternion_to_matrix(pose.quaternion) @ np.array([0.0, 0.0, 0.5 * height]) + np.array(
                pose.position
            )
            return Box((radius, radius, 0.5 * height)), Pose((float(x), float(y), float(z)), pose.quaternion)
        case _:
            return shape, pose


def signed_distance(shape: Solid, pose: Pose, points: Array) -> Array:
    """Signed distance (...) [m] of world `points` (..., 3) to the surface of `shape` at `pose`, negative inside."""
    local = (points - np.asarray(pose.position)) @ quaternion_to_matrix(pose.quaternion)
    match shape:
        case Sphere(radius):
            return _norm(*_columns(local)) - radius
        case Capsule(radius, half_length):
            local[..., 2] -= np.clip(local[..., 2], -half_length, half_length)
            return _norm(*_columns(local)) - radius
        case Box(half_extents):
            x, y, z = (np.abs(column) - half for column, half in zip(_columns(local), half_extents, strict=True))
            inside = np.minimum(np.maximum(np.maximum(x, y), z), 0.0)
            return _norm(*(np.maximum(outside, 0.0) for outside in (x, y, z))) + inside
        case HalfSpace():
            return local[..., 2]


def _columns(points: Array) -> tuple[Array, Array, Array]:
    """x, y and z of `points` (..., 3); adding three columns is faster than a sum over an axis of length 3."""
    return points[..., 0], points[..., 1], points[..., 2]


def _norm(x: Array, y: Array, z: Array) -> Array:
    return np.sqrt(x * x + y * y + z * z)


def _cylinder_covers(cylinder: Cylinder) -> Iterator[Solid]:
    """A box, a sphere, and capsules whose caps reach the rim of the cylinder."""
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
