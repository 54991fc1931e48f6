"""Spheres that cover a grasped object, so that the filter treats it like a link of the robot."""

from __future__ import annotations

from itertools import product
from math import hypot

import numpy as np
from numpy.typing import NDArray

from dualbrain.core.geometry.distance import bounding_solid
from dualbrain.core.geometry.rotations import quaternion_to_matrix
from dualbrain.core.geometry.shapes import Box, Capsule, Cylinder, Pose, Sphere
from dualbrain.errors import ConfigurationError
from dualbrain.records import SceneObject
from dualbrain.safety.cbf.obstacles import check_scene_object

Array = NDArray[np.float64]

MAX_SPHERES = 8
"""Most spheres that a grasped object may have."""


def cover_with_spheres(obj: SceneObject, tool_position: Array, tool_rotation: Array) -> Array:
    """Spheres (k, 4), k ≤ 8, of x, y, z, radius [m] in the tool frame that contain `obj` as perceived.

    `tool_position` is (3,) [m], `tool_rotation` (3, 3). Raises `ConfigurationError` if the shape is unbounded, and
    `GeometryError` if the object has a size or a pose that is not usable.
    """
    obj = check_scene_object(obj)
    spheres, pose = _local_spheres(obj)
    world = spheres[:, :3] @ quaternion_to_matrix(pose.quaternion).T + np.array(pose.position)
    return np.column_stack([(world - tool_position) @ tool_rotation, spheres[:, 3]])


def _local_spheres(obj: SceneObject) -> tuple[Array, Pose]:
    shape, pose = bounding_solid(obj.shape, obj.pose)
    match obj.shape:
        case Sphere(radius=r):
            return np.array([[0.0, 0.0, 0.0, r]]), obj.pose
        case Capsule(radius=r, half_length=h):
            return _capsule_spheres(r, h), obj.pose
        case Cylinder(radius=r, half_height=h):
            return min((_axis_spheres(r, h), _box_spheres((r, r, h))), key=lambda s: _excess(s, (r, r, h))), obj.pose
        case _ if isinstance(shape, Box):
            return _box_spheres(shape.half_extents), pose
        case _:
            raise ConfigurationError("shape of a grasped object", got=type(shape).__name__, allowed="a bounded solid")


def _capsule_spheres(radius: float, half_length: float) -> Array:
    """Spheres along z whose union contains a capsule; the outermost ones are centred on the ends of its axis."""
    z = np.linspace(-half_length, half_length, MAX_SPHERES)
    radii = np.full(MAX_SPHERES, hypot(radius, half_length / (MAX_SPHERES - 1)))
    return np.column_stack([np.zeros(MAX_SPHERES), np.zeros(MAX_SPHERES), z, radii])


def _axis_spheres(radius: float, half_length: float) -> Array:
    """Spheres along z whose union contains a cylinder."""
    count = max(1, min(MAX_SPHERES, round(2.0 * half_length / max(radius, 1e-3))))
    step = half_length / count
    z = -half_length + step * (1.0 + 2.0 * np.arange(count, dtype=np.float64))
    return np.column_stack([np.zeros(count), np.zeros(count), z, np.full(count, hypot(radius, step))])


def _box_spheres(extents: tuple[float, float, float]) -> Array:
    """Circumscribed spheres of equal cells of a box, for the division with the least excess."""
    divisions = (d for d in product(range(1, MAX_SPHERES + 1), repeat=3) if d[0] * d[1] * d[2] <= MAX_SPHERES)
    return min((_cell_spheres(extents, d) for d in divisions), key=lambda s: _excess(s, extents))


def _cell_spheres(extents: tuple[float, float, float], divisions: tuple[int, ...]) -> Array:
    half = np.array(extents) / np.array(divisions)
    axes = [
        -e + h * (1.0 + 2.0 * np.arange(d, dtype=np.float64)) for e, h, d in zip(extents, half, divisions, strict=True)
    ]
    centres = np.array(list(product(*axes)))
    return np.column_stack([centres, np.full(len(centres), float(np.linalg.norm(half)))])


def _excess(spheres: Array, extents: tuple[float, float, float]) -> float:
    """How far the spheres protrude from the box, at most [m]."""
    return float(np.max(np.abs(spheres[:, :3]) + spheres[:, 3:] - np.array(extents)))
