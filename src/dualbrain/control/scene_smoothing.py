"""Things at rest, averaged over looks: what stands still is seen better the longer one looks at it.

x̂ ← x̂ + (x − x̂) Δt / T. An average of sightings that each lie within the error bound lies within it too (a ball is
convex), so the bound handed to the filter stays true. A thing that is seen to have moved is believed at once.
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
"""A sighting farther than this many error bounds from the average means that the thing moved."""


class SceneSmoother:
    """The averaged positions, by name."""

    def __init__(self) -> None:
        """Nothing seen yet."""
        self._averages: dict[str, tuple[float, NDArray[np.float64]]] = {}

    def update(self, scene: Scene, moving: Collection[str] = ()) -> Scene:
        """`scene` with the positions of things at rest averaged; those in `unsteady` (held, just let go) as seen."""
        for name in moving:
            self._averages.pop(name, None)
        return msgspec.structs.replace(
            scene,
            objects=tuple(thing if thing.name in moving else self._average(thing) for thing in scene.objects),
        )

    def _average(self, thing: SceneObject) -> SceneObject:
        if thing.role in ("person", "support") or thing.error == 0.0:
            return thing
        at = np.asarray(thing.pose.position)
        stamp, mean = self._averages.get(thing.name, (thing.stamp, at))
        if float(np.linalg.norm(at - mean)) > MOVED_ERROR_BOUNDS * thing.error:
            mean = at
        else:
            mean = mean + (at - mean) * min(1.0, (thing.stamp - stamp) / TIME_CONSTANT)
        self._averages[thing.name] = (thing.stamp, mean)
        x, y, z = mean.tolist()
        return msgspec.structs.replace(thing, pose=Pose((x, y, z), thing.pose.quaternion))
