"""Paths over a support: the ends that an object can be carried to, and the objects on and above each path."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dualbrain.core.geometry.rotations import quaternion_to_matrix
from dualbrain.core.geometry.shapes import Bowl, Box, Capsule, Cylinder, HalfSpace, Sphere
from dualbrain.records import Scene, SceneObject
from dualbrain.skills.kinematics.object_geometry import bottom_height

Array = NDArray[np.float64]

PATH_WIDTH = 0.10
"""Objects within this distance of the direct path are on the path [m]."""
OVERHEAD_HEIGHT = 0.25
"""Obstacles whose lowest point is higher than this are overhead [m]."""


class PathEnd(NamedTuple):
    """The end of a path: its name and position (3,) [m]."""

    name: str
    position: Array


def path_ends(scene: Scene) -> list[PathEnd]:
    """The ends that a summary describes: every container; without a container, the place if there is only one."""
    containers = [PathEnd(obj.name, np.asarray(obj.pose.position)) for obj in scene.objects if obj.role == "container"]
    places = [PathEnd(place.name, np.asarray(place.position)) for place in scene.places]
    return containers or (places if len(places) == 1 else [])


def objects_on_path(scene: Scene, obj: SceneObject, end: PathEnd) -> list[SceneObject]:
    """The objects within `PATH_WIDTH` of the direct path of `obj` to `end`."""
    return [
        other for other in standing_objects(scene, obj.name, end.name) if distance_to_path(obj, end, other) < PATH_WIDTH
    ]


def overhead_objects_on_path(scene: Scene, obj: SceneObject, end: PathEnd) -> list[SceneObject]:
    """The obstacles above the direct path of `obj` to `end`."""
    return [other for other in _overhead_objects(scene) if distance_to_path(obj, end, other) < PATH_WIDTH]


def is_below_overhead_object(scene: Scene, spot: Array) -> bool:
    """Whether an overhead obstacle is within `PATH_WIDTH` of `spot` (2,) or (3,) [m] in the plane."""
    return any(
        float(np.linalg.norm(np.asarray(other.pose.position)[:2] - spot[:2])) - footprint_radius(other) < PATH_WIDTH
        for other in _overhead_objects(scene)
    )


def _overhead_objects(scene: Scene) -> list[SceneObject]:
    return [one for one in scene.objects if one.role == "obstacle" and bottom_height(one) >= OVERHEAD_HEIGHT]


def distance_to_path(obj: SceneObject, end: PathEnd, other: SceneObject) -> float:
    """Distance [m] in the plane between the footprint of `other` and the direct path of `obj` to `end`."""
    start, centre = np.asarray(obj.pose.position)[:2], np.asarray(other.pose.position)[:2]
    line = end.position[:2] - start
    along = float(np.clip((centre - start) @ line / (line @ line + 1e-12), 0.0, 1.0))
    return max(0.0, float(np.linalg.norm(centre - start - along * line)) - footprint_radius(other))


def standing_objects(scene: Scene, *without: str) -> list[SceneObject]:
    """The objects, containers and obstacles of `scene` that are not overhead, except those named in `without`."""
    kinds = ("object", "container", "obstacle")
    return [
        obj
        for obj in scene.objects
        if obj.role in kinds and obj.name not in without and bottom_height(obj) < OVERHEAD_HEIGHT
    ]


def footprint_radius(obj: SceneObject) -> float:
    """Radius [m] of the disc that covers the footprint of an object."""
    match obj.shape:
        case Sphere(radius) | Cylinder(radius, _) | Bowl(radius, _, _):
            return radius
        case Box(half_extents):
            return float(np.hypot(half_extents[0], half_extents[1]))
        case Capsule(radius, half_length):
            return radius + half_length * float(np.linalg.norm(quaternion_to_matrix(obj.pose.quaternion)[:2, 2]))
        case HalfSpace():
            return 0.0
