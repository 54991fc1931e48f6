"""Extents of perceived objects, distances from parts of the robot, and the tool rotations that grasp an object."""

from __future__ import annotations

from collections.abc import Sequence
from math import hypot

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dualbrain.core.geometry.distance import bounding_solid, signed_distance
from dualbrain.core.geometry.rotations import quaternion_to_matrix
from dualbrain.core.geometry.shapes import Bowl, Box, Capsule, Cylinder, Pose, Shape, Sphere
from dualbrain.records import Scene, SceneObject

Array = NDArray[np.float64]

APPROACH_LEAN = {"top": 0.0, "tilted": np.deg2rad(25.0), "side": np.deg2rad(45.0)}
"""Angle between the tool's approach axis and straight down [rad]; at 45° the hand clears the table at a 5 cm object."""

CLEARANCE = 0.010
"""Distance [m] from an object, beyond the error of its position, at which a part of the robot is clear of it."""


def axis_rotation(axis: ArrayLike, angle: float) -> Array:
    """Rotation (3, 3) by `angle` [rad] about the unit vector `axis` (Rodrigues)."""
    x, y, z = np.asarray(axis, dtype=np.float64)
    K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + np.sin(angle) * K + (1.0 - np.cos(angle)) * (K @ K)


def half_height(shape: Shape, pose: Pose) -> float:
    """Half the vertical extent [m] of `shape` at `pose` (of a bowl from its middle)."""
    up = quaternion_to_matrix(pose.quaternion)[2]
    match shape:
        case Sphere(radius):
            return radius
        case Capsule(radius, half_length):
            return radius + abs(float(up[2])) * half_length
        case Cylinder(radius, half):
            return abs(float(up[2])) * half + float(np.sqrt(max(0.0, 1.0 - up[2] ** 2))) * radius
        case Box(half_extents):
            return float(np.abs(up) @ np.asarray(half_extents))
        case Bowl(_, height, _):
            return height / 2
        case _:
            return 0.0


def top_height(obj: SceneObject) -> float:
    """Height of the highest point of `obj` [m]."""
    if isinstance(obj.shape, Bowl):
        return obj.pose.position[2] + obj.shape.height
    return obj.pose.position[2] + half_height(obj.shape, obj.pose)


def nearest_support(scene: Scene, x: float, y: float) -> SceneObject | None:
    """The support whose centre is horizontally nearest to the point (x, y) [m]; None if the scene has none."""
    supports = (obj for obj in scene.objects if obj.role == "support")
    return min(supports, key=lambda obj: hypot(obj.pose.position[0] - x, obj.pose.position[1] - y), default=None)


def bottom_height(obj: SceneObject) -> float:
    """Height of the lowest point of `obj` [m]."""
    return lowest_height(obj.shape, obj.pose)


def lowest_height(shape: Shape, pose: Pose) -> float:
    """Height of the lowest point of `shape` at `pose` [m]."""
    return pose.position[2] if isinstance(shape, Bowl) else pose.position[2] - half_height(shape, pose)


def grasp_width(obj: SceneObject, finger_axis: str) -> float:
    """Extent of `obj` between fingers that close along the named axis [m], in its current orientation."""
    direction, axes = finger_direction(obj, finger_axis), quaternion_to_matrix(obj.pose.quaternion)
    lean = abs(float(direction @ axes[:, 2]))
    match obj.shape:
        case Box(half_extents):
            return 2.0 * float(np.abs(direction @ axes) @ np.asarray(half_extents))
        case Sphere(radius) | Bowl(radius, _, _):
            return 2.0 * radius
        case Capsule(radius, half_length):
            return 2.0 * (radius + lean * half_length)
        case Cylinder(radius, half_height):
            return 2.0 * (radius * float(np.sqrt(max(0.0, 1.0 - lean * lean))) + lean * half_height)
        case _:
            return 0.0


def levelness(obj: SceneObject, finger_axis: str) -> float:
    """Length of the horizontal part of the named axis: 1 if the axis is level, 0 if it is vertical."""
    return float(np.linalg.norm(quaternion_to_matrix(obj.pose.quaternion)[:2, 0 if finger_axis == "along" else 1]))


def finger_direction(obj: SceneObject, finger_axis: str) -> Array:
    """Horizontal unit vector of the finger axis: local x of the object for "along", local y for "across"."""
    axes = quaternion_to_matrix(obj.pose.quaternion)
    direction = axes[:, 0 if finger_axis == "along" else 1].copy()
    direction[2] = 0.0
    length = float(np.linalg.norm(direction))
    return direction / length if length > 1e-6 else np.array([0.0, 1.0, 0.0])


def grasp_rotations(direction: Array, approach: str, towards: Array) -> list[Array]:
    """The tool rotations that grasp with the fingers along `direction` and the given approach.

    The tool leans about its finger axis by the angle of the approach, first outward (along `towards`, as seen from the
    base), and each lean has both directions of the fingers.
    """
    lean = float(APPROACH_LEAN[approach])
    sideways = np.array([-direction[1], direction[0], 0.0])
    if float(sideways @ towards) < 0.0:
        sideways = -sideways
    leans = (lean, -lean) if lean else (0.0,)
    rotations: list[Array] = []
    for angle in leans:
        z: Array = np.sin(angle) * sideways - np.cos(angle) * np.array([0.0, 0.0, 1.0])
        for y in (direction, -direction):
            x: Array = np.cross(y, z).astype(np.float64)
            rotations.append(np.column_stack([x, y, z]))
    return rotations


def extent_along(obj: SceneObject, direction: Array) -> float:
    """Extent of `obj` from its centre along the horizontal unit vector `direction` (2,) or (3,) [m]."""
    ahead, axes = np.array([direction[0], direction[1], 0.0]), quaternion_to_matrix(obj.pose.quaternion)
    lean = abs(float(ahead @ axes[:, 2]))
    match obj.shape:
        case Box(half_extents):
            return float(np.abs(ahead @ axes) @ np.asarray(half_extents))
        case Sphere(radius) | Bowl(radius, _, _):
            return radius
        case Capsule(radius, half_length):
            return radius + lean * half_length
        case Cylinder(radius, half_height):
            return radius * float(np.sqrt(max(0.0, 1.0 - lean * lean))) + lean * half_height
        case _:
            return 0.0


def part_clearance(obj: SceneObject, robot_part: str, centres: Array, radii: Array, groups: Sequence[str]) -> float:
    """Minimum distance [m] of `robot_part` from `obj`, minus the error of its position; inf if the part has no spheres.

    `centres` (k, 3) [m], `radii` (k,) [m] and `groups` are the spheres of the robot.
    """
    part = np.array([group == robot_part for group in groups])
    distances = signed_distance(*bounding_solid(obj.shape, obj.pose), centres[part]) - radii[part]
    return float(distances.min(initial=np.inf)) - obj.error
