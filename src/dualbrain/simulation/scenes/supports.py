"""Heights of the surfaces of a scene that hold objects: the table at z = 0, and the supports of a room."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from dualbrain.core.geometry.rotations import quaternion_to_matrix
from dualbrain.core.geometry.shapes import Box, Pose
from dualbrain.simulation.scenes.scene_spec import TABLE_X, TABLE_Y, ObjectSpec, SceneSpec
from dualbrain.skills.kinematics.object_geometry import half_height


def support_height(spec: SceneSpec, x: float, y: float) -> float | None:
    """Height [m] of the highest surface that holds objects at the point (x, y) [m]; None over the floor."""
    heights = [height for obj, height in _supports(spec) if _covers(obj, x, y)]
    if not spec.region and TABLE_X[0] <= x <= TABLE_X[1] and TABLE_Y[0] <= y <= TABLE_Y[1]:
        heights.append(0.0)
    return max(heights, default=None)


def _supports(spec: SceneSpec) -> Iterator[tuple[ObjectSpec, float]]:
    for obj in spec.objects:
        if obj.role == "support" and isinstance(obj.shape, Box):
            yield obj, obj.position[2] + half_height(obj.shape, Pose(obj.position, obj.quaternion))


def _covers(obj: ObjectSpec, x: float, y: float) -> bool:
    assert isinstance(obj.shape, Box)
    away = np.array([x - obj.position[0], y - obj.position[1], 0.0])
    return bool((np.abs(away @ quaternion_to_matrix(obj.quaternion))[:2] <= obj.shape.half_extents[:2]).all())
