"""Values of skill parameters that follow from the geometry of a scene, in the contract's own words.

A small language model cannot compute an opening from a width, but it copies a value that the scene states.
"""

from __future__ import annotations

import math

from dualbrain.grounding.scene_paths import PathEnd, objects_on_path, overhead_objects_on_path
from dualbrain.records import Scene, SceneObject
from dualbrain.skills.kinematics.object_geometry import grasp_width, top_height
from dualbrain.skills.parameters import LEVELS

OPENING_MARGIN = 0.015
"""A fitted opening exceeds the width of the object by this [m]: the gate requires 10 mm."""
PATH_MARGIN, MAX_FITTED_CLEARANCE = 0.04, 0.33
"""A fitted clearance exceeds the highest object on the path by the first, and is at most the second [m]."""


def fitted_opening(obj: SceneObject, finger_axis: str) -> float:
    """The narrowest opening [m] that leaves `OPENING_MARGIN` around `obj`, in whole millimetres."""
    widest = float(LEVELS["opening"]["wide"])
    return min(widest, math.ceil(1000.0 * (grasp_width(obj, finger_axis) + OPENING_MARGIN) - 1e-6) / 1000.0)


def path_clearance(scene: Scene, obj: SceneObject, end: PathEnd) -> float:
    """The clearance [m] with which `obj` passes over the objects on its direct path to `end`, in whole centimetres.

    Below an overhead obstacle that is too high to pass over it is the low level.
    """
    low, highest_passable = float(LEVELS["clearance"]["low"]), MAX_FITTED_CLEARANCE - PATH_MARGIN
    overhead = [top_height(other) for other in overhead_objects_on_path(scene, obj, end)]
    if any(height > highest_passable for height in overhead):
        return low
    tops = [*overhead, *(top_height(other) for other in objects_on_path(scene, obj, end))]
    fitted = math.ceil(100.0 * (max(tops, default=0.0) + PATH_MARGIN) - 1e-6) / 100.0
    return min(MAX_FITTED_CLEARANCE, max(low, fitted))
