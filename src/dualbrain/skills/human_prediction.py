"""Prediction of people: the precondition for moving an arm under or next to the path of a person (design 3)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from dualbrain.core.geometry.rotations import quaternion_to_matrix
from dualbrain.core.geometry.shapes import Capsule
from dualbrain.records import Scene, SceneObject
from dualbrain.skills.kinematics.object_geometry import top_height

Array = NDArray[np.float64]

VERTICAL_CLEARANCE = 0.05
"""Vertical distance [m]: a person who passes this far below the lowest point of the tool is not a threat."""
TIME_STEP = 0.2
"""Time step for the comparison of two paths [s]."""


def person_may_reach(scene: Scene, spot: Array, horizon: float, radius: float, now: float) -> bool:
    """Whether a person may come within `radius` [m] of `spot` (3,), seen from above, in the next `horizon` [s]."""
    return any(_sweeps(obj, spot, horizon, radius, now) for obj in scene.objects if obj.role == "person")


def threat_height(scene: Scene, spot: Array, lowest: float, horizon: float, radius: float, now: float) -> float | None:
    """Height [m] above which the tool is clear of all people who soon pass `spot`; None if there is no threat.

    `lowest` is the height of the lowest point of tool and load [m].
    """
    tops = [
        top_height(obj) + VERTICAL_CLEARANCE
        for obj in scene.objects
        if obj.role == "person" and _sweeps(obj, spot, horizon, radius, now)
    ]
    return max(tops) if tops and lowest < max(tops) else None


def min_person_distance(scene: Scene, path: Callable[[float], Array], horizon: float, now: float) -> float:
    """Least horizontal distance [m] between any person and `path`(t) (2,) over the next `horizon` [s].

    People are assumed to keep their velocity. The result is infinite if there are no people.
    """
    least = float("inf")
    times = np.arange(0.0, horizon, TIME_STEP)
    spots = np.array([path(t) for t in times.tolist()])
    for person in scene.objects:
        if person.role == "person":
            velocity = np.asarray(person.velocity)
            start = np.asarray(person.pose.position) + velocity * (now - person.stamp)
            radius, half = _axis(person)
            off = spots - (start[:2] + times[:, None] * velocity[:2])
            along = np.clip(off @ half / (half @ half + 1e-30), -1.0, 1.0)
            distance = np.linalg.norm(off - along[:, None] * half, axis=1) - radius - person.error
            least = min(least, float(distance.min()))
    return least


def _sweeps(person: SceneObject, spot: Array, horizon: float, max_distance: float, now: float) -> bool:
    """Whether `spot` is within `max_distance` of the area that the person sweeps at constant velocity."""
    velocity = np.asarray(person.velocity)
    start = np.asarray(person.pose.position) + velocity * (now - person.stamp)
    radius, half = _axis(person)
    return _distance_to_sweep((spot - start)[:2], horizon * velocity[:2], half) < max_distance + radius + person.error


def _distance_to_sweep(spot: Array, path: Array, half: Array) -> float:
    """Distance [m] of `spot` (2,) from the area that a segment from -half to half (2,) sweeps along `path` (2,).

    The least |spot - a path - s half| over a in [0, 1] and s in [-1, 1]: 0 inside that parallelogram, else on an edge.
    """
    area = _cross(path, half)
    if area and 0.0 <= _cross(spot, half) / area <= 1.0 and abs(_cross(path, spot) / area) <= 1.0:
        return 0.0
    sides = [_distance_to_segment(spot - end * half, 0.5 * path, 0.5 * path) for end in (-1.0, 1.0)]
    return min(*sides, *(_distance_to_segment(spot, end * path, half) for end in (0.0, 1.0)))


def _distance_to_segment(spot: Array, middle: Array, half: Array) -> float:
    """Distance of `spot` from the segment between middle - half and middle + half."""
    off = spot - middle
    along = min(1.0, max(-1.0, float(off @ half) / (float(half @ half) + 1e-30)))
    return float(np.hypot(*(off - along * half)))


def _cross(a: Array, b: Array) -> float:
    return float(a[0] * b[1] - a[1] * b[0])


def _axis(person: SceneObject) -> tuple[float, Array]:
    """Radius [m] and horizontal half axis (2,) [m] of a person."""
    if isinstance(person.shape, Capsule):
        return person.shape.radius, (quaternion_to_matrix(person.pose.quaternion)[:, 2] * person.shape.half_length)[:2]
    return 0.3, np.zeros(2)
