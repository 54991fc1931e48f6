"""Averaging of the perceived positions of objects at rest: x̂ ← x̂ + (x − x̂) Δt / T.

If every measurement is within the error bound, so is their average, because a ball is convex. The bound that the filter
gets therefore remains valid. The position of an object that has moved is taken over at once.
"""

from __future__ import annotations

from collections.abc import Collection

import msgspec
import numpy as np
from numpy.typing import NDArray

from dualbrain.core.geometry.shapes import Pose
from dualbrain.records import Scene, SceneObject

TIME_CONSTANT = 1.0
"""Time constant T of the average [s]."""
MOVED_ERROR_BOUNDS = 2.0
"""Distance of a measurement from the average, in error bounds, beyond which the object has moved."""


class SceneSmoother:
    """Averages the positions of objects at rest. State: stamp [s] and averaged position (3,) [m] by object name."""

    def __init__(self) -> None:
        """Start without measurements."""
        self._averages: dict[str, tuple[float, NDArray[np.float64]]] = {}

    def update(self, scene: Scene, moving: Collection[str] = ()) -> Scene:
        """`scene` with averaged positions of objects at rest; those in `moving` (held, just released) are unchanged."""
        for name in moving:
            self._averages.pop(name, None)
        return msgspec.structs.replace(
            scene,
            objects=tuple(obj if obj.name in moving else self._average(obj) for obj in scene.objects),
        )

    def _average(self, obj: SceneObject) -> SceneObject:
        if obj.role in ("person", "support") or obj.error == 0.0:
            return obj
        position = np.asarray(obj.pose.position)
        stamp, mean = self._averages.get(obj.name, (obj.stamp, position))
        if float(np.linalg.norm(position - mean)) > MOVED_ERROR_BOUNDS * obj.error:
            mean = position
        else:
            mean = mean + (position - mean) * min(1.0, (obj.stamp - stamp) / TIME_CONSTANT)
        self._averages[obj.name] = (obj.stamp, mean)
        x, y, z = mean.tolist()
        return msgspec.structs.replace(obj, pose=Pose((x, y, z), obj.pose.quaternion))
