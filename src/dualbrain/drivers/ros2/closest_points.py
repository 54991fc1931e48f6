"""The closest points of robot and obstacles, for the markers of the node."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dualbrain.core.geometry.distance import signed_distance
from dualbrain.core.geometry.rotations import quaternion_to_matrix
from dualbrain.core.geometry.shapes import Box, Capsule, HalfSpace, Pose, Sphere
from dualbrain.robots.model import Link, RobotModel
from dualbrain.safety.cbf.filter import SafetyFilter

Array = NDArray[np.float64]

Solid = Sphere | Capsule | Box | HalfSpace


@dataclass(frozen=True, slots=True, kw_only=True)
class ClosestPoints:
    """The points (3,) [m] of the robot and of one obstacle that are closest, and their distance [m]."""

    obstacle: str
    on_robot: Array
    on_obstacle: Array
    distance: float


def closest_points(safety: SafetyFilter, q: Array) -> list[ClosestPoints]:
    """The closest points for every obstacle of `safety` with the robot at q (n,); margins are not included.

    The robot is covered by its collision spheres, of the fingers at every opening. The fixed base does not count, and
    for an obstacle that names parts only these.
    """
    centres, radii, _ = safety.spheres(q, None)
    links = _sphere_links(safety.robot_model)
    found: list[ClosestPoints] = []
    for obstacle in safety.tables.obstacles:
        kept = [
            index
            for index, link in enumerate(links)
            if link.frame > 0 and (not obstacle.parts or {link.name, link.group} & set(obstacle.parts))
        ]
        if not kept:
            continue
        gaps = signed_distance(obstacle.shape, obstacle.pose, centres[kept]) - radii[kept]
        nearest = kept[int(np.argmin(gaps))]
        centre = centres[nearest]
        other = closest_point(obstacle.shape, obstacle.pose, centre)
        to_other = other - centre
        length = float(np.linalg.norm(to_other))
        on_robot = centre + to_other * (float(radii[nearest]) / length) if length > 0.0 else centre
        found.append(
            ClosestPoints(obstacle=obstacle.name, on_robot=on_robot, on_obstacle=other, distance=float(gaps.min()))
        )
    return found


def _sphere_links(robot_model: RobotModel) -> list[Link]:
    """The link of every sphere, in the order of `SafetyFilter.spheres`."""
    return [link for link in robot_model.links for sphere in robot_model.spheres if sphere.link == link.name]


def closest_point(shape: Solid, pose: Pose, point: Array) -> Array:
    """The point (3,) on the surface of `shape` at `pose` that is closest to `point` (3,)."""
    rotation, origin = quaternion_to_matrix(pose.quaternion), np.asarray(pose.position)
    return origin + rotation @ _closest_local(shape, rotation.T @ (point - origin))


def _closest_local(shape: Solid, local: Array) -> Array:
    match shape:
        case Sphere(radius):
            return _on_sphere(np.zeros(3), radius, local)
        case Capsule(radius, half_length):
            axis = np.array([0.0, 0.0, np.clip(local[2], -half_length, half_length)])
            return _on_sphere(axis, radius, local)
        case Box(half_extents):
            return _on_box(np.array(half_extents), local)
        case HalfSpace():
            return np.array([local[0], local[1], 0.0])


def _on_sphere(centre: Array, radius: float, point: Array) -> Array:
    offset = point - centre
    length = float(np.linalg.norm(offset))
    direction = offset / length if length > 0.0 else np.array([1.0, 0.0, 0.0])
    return centre + radius * direction


def _on_box(half: Array, point: Array) -> Array:
    clamped = np.clip(point, -half, half)
    if not np.array_equal(clamped, point):
        return clamped
    axis = int(np.argmin(half - np.abs(point)))  # inside: the nearest face
    clamped[axis] = half[axis] if point[axis] >= 0.0 else -half[axis]
    return clamped
