"""Where a person may be soon: the precondition for putting an arm below or beside someone's sweep (design 3)."""

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
"""Whoever passes this far below the lowest point of the tool is no threat [m]."""
TIME_STEP = 0.2
"""Step of time in which two ways are compared [s]."""


def person_may_reach(scene: Scene, spot: Array, horizon: float, radius: float, now: float) -> bool:
    """Whether any person's sweep over the next `horizon` [s] comes within `reach` [m] of `spot` (3,), from above."""
    return any(_sweeps(thing, spot, horizon, radius, now) for thing in scene.objects if thing.role == "person")


def threat_height(scene: Scene, spot: Array, lowest: float, horizon: float, radius: float, now: float) -> float | None:
    """Height [m] above which the tool is out of the way of everyone who soon sweeps by `spot`; None if nobody does.

    `lowest` is the height of the lowest point of tool and load [m].
    """
    tops = [
        top_height(thing) + VERTICAL_CLEARANCE
        for thing in scene.objects
        if thing.role == "person" and _sweeps(thing, spot, horizon, radius, now)
    ]
    return max(tops) if tops and lowest < max(tops) else None


def min_person_distance(scene: Scene, path: Callable[[float], Array], horizon: float, now: float) -> float:
    """Least distance [m] in the plane between any person, who goes on as now, and whoever is at `way`(t) (2,) at t [s].

    Infinite when nobody is there.
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
            apart = np.linalg.norm(off - along[:, None] * half, axis=1) - radius - person.error
            least = min(least, float(apart.min()))
    return least


def _sweeps(person: SceneObject, spot: Array, horizon: float, max_distance: float, now: float) -> bool:
    """Whether `spot` lies within `reach` of what the person's axis, going on as now, sweeps in the plane."""
    velocity = np.asarray(person.velocity)
    start = np.asarray(person.pose.position) + velocity * (now - person.stamp)
    radius, half = _axis(person)
    return _distance_to_sweep((spot - start)[:2], horizon * velocity[:2], half) < max_distance + radius + person.error


def _distance_to_sweep(spot: Array, path: Array, half: Array) -> float:
    """Distance [m] of `spot` (2,) from what a segment from -half to half (2,) sweeps on its straight `path` (2,).

    The least |spot - a path - s half| over a in [0, 1] and s in [-1, 1]: 0 inside that parallelogram, else on an edge.
    """
    area = _cross(path, half)
    if area and 0.0 <= _cross(spot, half) / area <= 1.0 and abs(_cross(path, spot) / area) <= 1.0:
        return 0.0
    sides = [_distance_to_segment(spot - end * half, 0.5 * path, 0.5 * path) for end in (-1.0, 1.0)]
    return min(*sides, *(_distance_to_segment(spot, end * path, half) for end in (0.0, 1.0)))


def _distance_to_segment(spot: Array, middle: Array, half: Array) -> float:
    """Distance of `spot` from the segment from middle - half to middle + half."""
    off = spot - middle
    along = min(1.0, max(-1.0, float(off @ half) / (float(half @ half) + 1e-30)))
    return float(np.hypot(*(off - along * half)))


def _cross(a: Array, b: Array) -> float:
    return float(a[0] * b[1] - a[1] * b[0])


def _axis(person: SceneObject) -> tuple[float, Array]:
    """Radius [m] and half axis (2,) [m] in the plane."""
    if isinstance(person.shape, Capsule):
        return person.shape.radius, (quaternion_to_matrix(person.pose.quaternion)[:, 2] * person.shape.half_length)[:2]
    return 0.3, np.zeros(2)
