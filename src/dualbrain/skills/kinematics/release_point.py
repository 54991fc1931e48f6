"""The point at which a load is released: on a place, above the centre of a bowl, or beside the contents of a bowl.

A load with the half width w fits into a bowl of inner radius R up to the offset R − w − `WALL_CLEARANCE` from its
centre. The centre is taken if nothing is under it; otherwise the offset with the largest gap to the contents. If
contents remain within `CONTENTS_CLEARANCE` of the load, it is released above their top.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dualbrain.core.geometry.shapes import Bowl
from dualbrain.records import Scene, SceneObject
from dualbrain.skills.kinematics import object_geometry

Array = NDArray[np.float64]

PLACE_RADIUS = 0.05
"""Distance [m] from a place, or from the centre of a container that is no bowl, at which an object counts as placed."""
RIM_CLEARANCE = 0.012
"""Clearance between the held object and the rim at the release [m]."""
DROP_HEIGHT = 0.004
"""Height above a support at which an object is released [m]."""
WALL_CLEARANCE = 0.008
"""Clearance between the held object and the inner wall of a bowl [m]."""
CONTENTS_CLEARANCE = 0.012
"""Clearance between the held object and the contents of a bowl [m]."""
OFFSET_ANGLES = np.arange(16) * np.pi / 8.0
"""Directions [rad] of the points beside the centre of a bowl."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ReleasePoint:
    """The release of a load at a destination.

    `position` (3,) [m] is the lowest point of the load at the release. The object counts as placed within `radius` [m]
    of `centre` (2,) [m]. `leaning` is whether the hand may lean, so that it fits above a rim. `surface` [m] is the
    height of the surface that bears the load below `position`; None if the load falls into a bowl.
    """

    position: Array
    centre: Array
    radius: float
    leaning: bool
    surface: float | None


def receiving_point(scene: Scene, destination: str) -> Array:
    """The centre (3,) [m] of `destination` at its receiving height."""
    for place in scene.places:
        if place.name == destination:
            return np.asarray(place.position)
    obj = scene.find(destination)
    return np.array([*obj.pose.position[:2], object_geometry.top_height(obj)])


def find_release_point(scene: Scene, destination: str, load: str) -> ReleasePoint:
    """The release of the object `load` at `destination`, a container or place of `scene`."""
    point = receiving_point(scene, destination)
    if all(obj.name != destination for obj in scene.objects):
        return _release_on(point, DROP_HEIGHT, leaning=False)
    container = scene.find(destination)
    if not isinstance(container.shape, Bowl):
        return _release_on(point, RIM_CLEARANCE, leaning=True)
    offset, height = _offset_in_bowl(scene, container, container.shape, scene.find(load))
    position = np.array([*(point[:2] + offset), max(float(point[2]) + RIM_CLEARANCE, height)])
    return ReleasePoint(position=position, centre=point[:2], radius=container.shape.radius, leaning=True, surface=None)


def _release_on(point: Array, drop_height: float, *, leaning: bool) -> ReleasePoint:
    """The release `drop_height` [m] above `point` (3,) [m] of a surface."""
    return ReleasePoint(
        position=point + np.array([0.0, 0.0, drop_height]),
        centre=point[:2],
        radius=PLACE_RADIUS,
        leaning=leaning,
        surface=float(point[2]),
    )


def _offset_in_bowl(scene: Scene, container: SceneObject, bowl: Bowl, load: SceneObject) -> tuple[Array, float]:
    """The offset (2,) [m] from the centre of a bowl, and the least height [m] of the load above its contents."""
    contents = _contents(scene, container, bowl, load)
    reach = max(0.0, bowl.radius - bowl.wall - _half_width(load) - WALL_CLEARANCE)
    ring = reach * np.column_stack([np.cos(OFFSET_ANGLES), np.sin(OFFSET_ANGLES)])
    offsets = [np.zeros(2), *ring]
    gaps = [_gaps(np.asarray(container.pose.position[:2]) + offset, load, contents) for offset in offsets]
    smallest = [min(one, default=np.inf) for one in gaps]
    best = 0 if smallest[0] >= CONTENTS_CLEARANCE else int(np.argmax(smallest))
    near = [obj for obj, gap in zip(contents, gaps[best], strict=True) if gap < CONTENTS_CLEARANCE]
    tops = [object_geometry.top_height(obj) + obj.error + CONTENTS_CLEARANCE for obj in near]
    return offsets[best], max(tops, default=-np.inf)


def _contents(scene: Scene, container: SceneObject, bowl: Bowl, load: SceneObject) -> list[SceneObject]:
    """The objects whose centre is above the bowl or inside it."""
    centre = np.asarray(container.pose.position[:2])
    return [
        obj
        for obj in scene.objects
        if obj.role == "object"
        and obj.name != load.name
        and float(np.linalg.norm(np.asarray(obj.pose.position[:2]) - centre)) < bowl.radius
    ]


def _gaps(position: Array, load: SceneObject, contents: list[SceneObject]) -> list[float]:
    """The horizontal gap [m] between the load at `position` (2,) and each of the contents; negative if they overlap."""
    width = _half_width(load)
    return [
        float(np.linalg.norm(np.asarray(obj.pose.position[:2]) - position)) - width - _half_width(obj) - obj.error
        for obj in contents
    ]


def _half_width(obj: SceneObject) -> float:
    """The largest horizontal extent [m] from the centre of `obj`, in its perceived orientation."""
    directions = np.column_stack([np.cos(OFFSET_ANGLES), np.sin(OFFSET_ANGLES)])
    return max(object_geometry.extent_along(obj, direction) for direction in directions)
