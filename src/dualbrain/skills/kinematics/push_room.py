"""The distance by which an object can be pushed over its support: to the edge, and to the next thing in its way.

The outline of the object moves in a straight line and does not turn. It stays on a bounded support with its whole
outline, and ends before the first thing whose outline is beside the line by less than both half widths and whose height
overlaps. The errors of both positions count toward the edge and toward a thing ahead.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import inf

import numpy as np
from numpy.typing import NDArray

from dualbrain.core.geometry.rotations import quaternion_to_matrix
from dualbrain.core.geometry.shapes import Box
from dualbrain.records import Scene, SceneObject
from dualbrain.skills.kinematics.object_geometry import bottom_height, extent_along, top_height

Array = NDArray[np.float64]

IN_THE_WAY = ("object", "container", "obstacle")
"""Roles of the things against which an object is not pushed."""
LEAST_OVERLAP = 0.01
"""Common height [m] from which two things meet; below it one is on the other, within the errors of perception."""
SUPPORT_GAP = 0.03
"""An object whose lowest point is within this of the top of a support rests on it [m]."""


@dataclass(frozen=True, slots=True)
class PushRoom:
    """The longest `distance` [m] of a push; `limit` is the thing or support at which it ends, "" if there is none."""

    distance: float
    limit: str = ""


def push_room(scene: Scene, obj: SceneObject, direction: Array) -> PushRoom:
    """The room of a push of `obj` along the horizontal unit vector `direction` (2,)."""
    rooms = [
        *(PushRoom(_distance_to_edge(one, obj, direction), f"the edge of {one.name}") for one in _supports(scene, obj)),
        *(PushRoom(_distance_to(one, obj, direction), one.name) for one in _things_in_the_way(scene, obj, direction)),
    ]
    return min(rooms, key=lambda one: one.distance, default=PushRoom(inf))


def _supports(scene: Scene, obj: SceneObject) -> list[SceneObject]:
    """The bounded support under `obj`; empty for a support without an edge."""
    return [
        one
        for one in scene.objects
        if one.role == "support"
        and isinstance(one.shape, Box)
        and abs(bottom_height(obj) - top_height(one)) <= SUPPORT_GAP + obj.error
        and all(abs(inner) <= half for inner, half, _ in _in_frame(one, one.shape, obj))
    ]


def _in_frame(support: SceneObject, shape: Box, obj: SceneObject) -> list[tuple[float, float, Array]]:
    """For both horizontal axes of a box: the position of `obj`, half the extent of the box [m], and the axis (2,)."""
    axes = quaternion_to_matrix(support.pose.quaternion)[:2, :2]
    offset = np.subtract(obj.pose.position, support.pose.position)[:2]
    return [(float(offset @ axes[:, k]), shape.half_extents[k], axes[:, k]) for k in (0, 1)]


def _distance_to_edge(support: SceneObject, obj: SceneObject, direction: Array) -> float:
    """The distance [m] after which the outline of `obj` would leave the box `support`."""
    assert isinstance(support.shape, Box)
    distance = inf
    for inner, half, axis in _in_frame(support, support.shape, obj):
        speed = float(direction @ axis)
        if abs(speed) > 1e-9:
            left = half - np.sign(speed) * inner - extent_along(obj, axis) - obj.error - support.error
            distance = min(distance, max(0.0, float(left) / abs(speed)))
    return distance


def _things_in_the_way(scene: Scene, obj: SceneObject, direction: Array) -> list[SceneObject]:
    """The things ahead of `obj` that its outline would meet."""
    across = np.array([-direction[1], direction[0]])

    def meets(one: SceneObject) -> bool:
        offset = np.subtract(one.pose.position, obj.pose.position)[:2]
        beside = abs(float(offset @ across)) - extent_along(one, across) - extent_along(obj, across)
        overlap = min(top_height(one), top_height(obj)) - max(bottom_height(one), bottom_height(obj))
        return float(offset @ direction) > 0.0 > beside and overlap > LEAST_OVERLAP

    return [one for one in scene.objects if one.role in IN_THE_WAY and one.name != obj.name and meets(one)]


def _distance_to(one: SceneObject, obj: SceneObject, direction: Array) -> float:
    """The distance [m] after which `obj` would touch `one`."""
    ahead = float(np.subtract(one.pose.position, obj.pose.position)[:2] @ direction)
    return max(0.0, ahead - extent_along(one, direction) - extent_along(obj, direction) - one.error - obj.error)
