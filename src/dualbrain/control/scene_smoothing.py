"""Averaging of the perceived positions of objects at rest: x̂ ← x̂ + (x − x̂) Δt / T.

If every measurement is within the error bound, so is their average, because a ball is convex. The bound that the filter
gets therefore remains valid. The position of an object that has moved is taken over at once.

The average stays within the error bound of the newest measurement: an average further away is moved toward it until
then. After a displacement that is too small to be recognised, the average is wrong by at most the bound plus the error
of the newest measurement.
"""

from __future__ import annotations

from collections.abc import Collection
from math import dist

import msgspec

from dualbrain.core.geometry.shapes import Pose, Vector
from dualbrain.records import Scene, SceneObject

TIME_CONSTANT = 1.0
"""Time constant T of the average [s]."""
MOVED_ERROR_BOUNDS = 2.0
"""Distance of a measurement from the average, in error bounds, beyond which the object has moved."""


class SceneSmoother:
    """Averages the positions of objects at rest. State: stamp [s] and averaged position (3,) [m] by object name."""

    def __init__(self) -> None:
        """Start without measurements."""
        self._averages: dict[str, tuple[float, Vector]] = {}

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
        position = obj.pose.position
        stamp, mean = self._averages.get(obj.name, (obj.stamp, position))
        if dist(position, mean) > MOVED_ERROR_BOUNDS * obj.error:
            mean = position
        else:
            mean = _between(mean, position, min(1.0, (obj.stamp - stamp) / TIME_CONSTANT))
            if (apart := dist(position, mean)) > obj.error:
                mean = _between(mean, position, 1.0 - obj.error / apart)
        self._averages[obj.name] = (obj.stamp, mean)
        return msgspec.structs.replace(obj, pose=Pose(mean, obj.pose.quaternion))


def _between(start: Vector, end: Vector, share: float) -> Vector:
    """The point (3,) [m] at the `share` of the way from `start` to `end`."""
    (x, y, z), (a, b, c) = start, end
    return (x + (a - x) * share, y + (b - y) * share, z + (c - z) * share)
