"""The outline of a perceived thing as coarsely as the filter sees it, and how far points are from it."""

from __future__ import annotations

from math import hypot, pi, sqrt

import numpy as np
from numpy.typing import NDArray

from dualbrain.linalg import matrix
from dualbrain.records import Bowl, Box, Capsule, Cylinder, HalfSpace, Pose, SceneObject, Sphere

Array = NDArray[np.float64]

Solid = Sphere | Capsule | Box | HalfSpace


def outline(thing: SceneObject) -> tuple[Solid, Pose]:
    """The shape that the filter keeps away from, and where it is: cylinders by volume, bowls as full boxes."""
    match thing.shape:
        case Cylinder():
            return _round(thing.shape), thing.pose
        case Bowl(radius=radius, height=height):
            up = matrix(thing.pose.quaternion)[:, 2]
            x, y, z = (np.asarray(thing.pose.position) + 0.5 * height * up).tolist()
            return Box((radius, radius, 0.5 * height)), Pose((x, y, z), thing.pose.quaternion)
        case Sphere() | Capsule() | Box() | HalfSpace():
            return thing.shape, thing.pose


def distance(solid: tuple[Solid, Pose], points: Array) -> Array:
    """Signed distance (...) [m] of `points` (..., 3) in the world from the surface."""
    shape, pose = solid
    local = (points - np.asarray(pose.position)) @ matrix(pose.quaternion)
    match shape:
        case Sphere(radius):
            return np.linalg.norm(local, axis=-1) - radius
        case Capsule(radius, half_length):
            local[..., 2] -= np.clip(local[..., 2], -half_length, half_length)
            return np.linalg.norm(local, axis=-1) - radius
        case Box(half_extents):
            beyond = np.abs(local) - np.asarray(half_extents)
            return np.linalg.norm(np.maximum(beyond, 0.0), axis=-1) + np.minimum(beyond.max(axis=-1), 0.0)
        case HalfSpace():
            return local[..., 2]


def _round(cylinder: Cylinder) -> Solid:
    """The smallest of a box, a ball, and capsules whose caps reach the rim."""
    r, h = cylinder.radius, cylinder.half_height
    capsules = [Capsule(sqrt(r * r + (h * (1.0 - share)) ** 2), share * h) for share in (0.25, 0.5, 0.75, 1.0)]
    volumes: list[tuple[float, Solid]] = [(8.0 * r * r * h, Box((r, r, h)))]
    volumes += [(4.0 / 3.0 * pi * hypot(r, h) ** 3, Sphere(hypot(r, h)))]
    volumes += [(pi * c.radius**2 * (4.0 / 3.0 * c.radius + 2.0 * c.half_length), c) for c in capsules]
    return min(volumes, key=lambda pair: pair[0])[1]
