"""The kernel's float64 reference distances, built from a `RobotModel` without any numbers of the filter's own model."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from dualbrain.core.geometry.shapes import Box, Capsule, HalfSpace, Sphere
from dualbrain.robots.model import RobotModel
from dualbrain.safety.cbf.compiled._kernel import ReferenceDistance
from dualbrain.safety.cbf.obstacles import Obstacle

Array = NDArray[np.float64]
N_COLUMNS = 24


def build_judge(robot_model: RobotModel, opening: float = 0.0) -> ReferenceDistance:
    """Reference distances for `robot_model` with the fingers held at `opening` [m]."""
    centres, radii, first = [], [], [0]
    for link in robot_model.links:
        turn, shift = rotation_matrix(link.quaternion), np.array(link.translation) + 0.0
        for sphere in (s for s in robot_model.spheres if s.link == link.name):
            centres.append(shift + turn @ (np.array(sphere.centre) + opening * np.array(link.slide)))
            radii.append(sphere.radius)
        first.append(len(radii))
    names = [link.name for link in robot_model.links]
    joints = robot_model.joints
    return ReferenceDistance(
        {
            "n": robot_model.n,
            "rotation": np.concatenate([rotation_matrix(j.quaternion).ravel() for j in joints]),
            "offset": np.concatenate([np.array(j.translation) for j in joints]),
            "lower": np.array([j.lower.value for j in joints]),
            "upper": np.array([j.upper.value for j in joints]),
            "v_max": np.array([j.velocity.value for j in joints]),
            "a_max": np.array([j.acceleration.value for j in joints]),
            "frame": np.array([float(link.frame) for link in robot_model.links]),
            "first": np.array(first, float),
            "pairs": np.array([float(names.index(n)) for pair in robot_model.self_pairs.kept for n in pair]),
            "centres": np.ascontiguousarray(centres),
            "radii": np.array(radii),
        }
    )


def rotation_matrix(quaternion: Sequence[float]) -> Array:
    """Matrix (3, 3) of a unit quaternion (w, x, y, z), by Rodrigues' formula."""
    w, axis = quaternion[0], np.array(quaternion[1:])
    cross = np.cross(np.eye(3), axis)
    return np.eye(3) + 2.0 * w * cross + 2.0 * cross @ cross


def obstacle_rows(obstacles: Sequence[Obstacle]) -> Array:
    """The true obstacles as rows (k, 24) for `ReferenceDistance`; margins concern the filter only."""
    rows = np.zeros((len(obstacles), N_COLUMNS))
    for row, obstacle in zip(rows, obstacles, strict=True):
        match obstacle.shape:
            case Sphere(radius=radius):
                row[0], row[17] = 0, radius
            case Capsule(radius=radius, half_length=length):
                row[0], row[16], row[17] = 0, length, radius
            case Box(half_extents=extents):
                row[0], row[14:17] = 1, extents
            case HalfSpace():
                row[0] = 2
        row[1] = not obstacle.static
        row[2:5], row[5:14] = obstacle.pose.position, rotation_matrix(obstacle.pose.quaternion).ravel()
        row[18:21] = obstacle.velocity
    return rows


def true_h(judge: ReferenceDistance, q: Array, obstacles: Sequence[Obstacle], period: float = 1e-3) -> Array:
    """True h at the postures q (t, n), as columns (t, 5).

    The columns are: static obstacles, moving obstacles, own links [m], joint limits [rad], speed of approach [m/s].
    """
    out = np.empty((len(q), 5))
    judge.measure(np.ascontiguousarray(q), obstacle_rows(obstacles), period, out)
    return out
