"""Spheres that cover a held thing, so that it is kept from obstacles like a part of the body."""

from __future__ import annotations

from itertools import product
from math import hypot

import numpy as np
from numpy.typing import NDArray

from dualbrain.core.geometry.distance import solid
from dualbrain.core.geometry.rotations import matrix
from dualbrain.core.geometry.shapes import Box, Capsule, Cylinder, Pose, Sphere
from dualbrain.errors import InvalidSetup
from dualbrain.records import SceneObject

Array = NDArray[np.float64]

MOST = 8
"""Spheres that a held thing may have."""


def cover(thing: SceneObject, tool_position: Array, tool_rotation: Array) -> Array:
    """Spheres (k, 4) of x, y, z, radius [m] in the tool frame that contain `thing` as perceived, k ≤ 8."""
    spheres, pose = _local(thing)
    world = spheres[:, :3] @ matrix(pose.quaternion).T + np.array(pose.position)
    return np.column_stack([(world - tool_position) @ tool_rotation, spheres[:, 3]])


def _local(thing: SceneObject) -> tuple[Array, Pose]:
    shape, pose = solid(thing.shape, thing.pose)
    match thing.shape:
        case Sphere(radius=r):
            return np.array([[0.0, 0.0, 0.0, r]]), thing.pose
        case Capsule(radius=r, half_length=h):
            return _slices(r, h, 0.0), thing.pose
        case Cylinder(radius=r, half_height=h):
            return min((_slices(r, h, h), _grid((r, r, h))), key=lambda s: _excess(s, (r, r, h))), thing.pose
        case _ if isinstance(shape, Box):
            return _grid(shape.half_extents), pose
        case _:
            raise InvalidSetup("a held thing's shape", got=type(shape).__name__, allowed="a bounded solid")


def _slices(radius: float, half_length: float, ends: float) -> Array:
    """Spheres along z whose union holds the segment's tube; `ends` > 0 closes a flat-ended cylinder as well."""
    count = MOST if ends == 0.0 else max(1, min(MOST, round(2.0 * half_length / max(radius, 1e-3))))
    step = half_length / count
    z = -half_length + step * (1.0 + 2.0 * np.arange(count, dtype=np.float64))
    return np.column_stack([np.zeros(count), np.zeros(count), z, np.full(count, hypot(radius, step))])


def _grid(extents: tuple[float, float, float]) -> Array:
    """Equal cells of a box, each in its circumscribed sphere; the division with the least excess."""
    divisions = (d for d in product(range(1, MOST + 1), repeat=3) if d[0] * d[1] * d[2] <= MOST)
    return min((_cells(extents, d) for d in divisions), key=lambda s: _excess(s, extents))


def _cells(extents: tuple[float, float, float], divisions: tuple[int, ...]) -> Array:
    half = np.array(extents) / np.array(divisions)
    axes = [
        -e + h * (1.0 + 2.0 * np.arange(d, dtype=np.float64)) for e, h, d in zip(extents, half, divisions, strict=True)
    ]
    centres = np.array(list(product(*axes)))
    return np.column_stack([centres, np.full(len(centres), float(np.linalg.norm(half)))])


def _excess(spheres: Array, extents: tuple[float, float, float]) -> float:
    """How far the spheres stand out of the box, at worst [m]."""
    return float(np.max(np.abs(spheres[:, :3]) + spheres[:, 3:] - np.array(extents)))
