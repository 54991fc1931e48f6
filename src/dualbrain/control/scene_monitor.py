"""What a perceived scene says of itself: how old it is, and whether it can be at all.

A scene is believed only if its numbers are finite, what is fixed has not moved, nothing has gone faster than anything
here can, and what is seen with an error is not seen again and again equal to the bit (a camera that hangs and stamps
its old picture anew). One camera can lie in ways that this does not see: a shift within these bounds, or an old picture
with fresh noise.
"""

from __future__ import annotations

import numpy as np

from dualbrain.records import STILL, Scene, SceneObject
from dualbrain.safety.supervisor.conditions import Condition
from dualbrain.safety.supervisor.frozen_sensor import Repetition, Sighting
from dualbrain.safety.supervisor.state_monitor import Bounds

MISSED = 0.5
"""A person who was not seen for this long [s] may be anywhere: the filter is told that its scene is that old."""
FIXED = ("support", "obstacle")
"""Roles of things that stay where they are."""
FASTEST = 2.5
"""Nothing that moves here is faster than this [m/s]: a person's hand, a thing that falls from a table."""
SLACK = 0.01
"""What a fixed thing may seem to move beyond its error bound [m]."""


def believed(scene: Scene) -> float:
    """The stamp [s] to judge the scene's age by: its own, or that of a person who has not been seen for too long.

    A person is carried forward along the last velocity for a while; after `MISSED` the filter must stop instead.
    """
    seen = min((thing.stamp for thing in scene.objects if thing.role == "person"), default=scene.stamp)
    return scene.stamp if scene.stamp - seen < MISSED else seen


class SceneWatch:
    """Compares each scene with the last one that was believed."""

    def __init__(self, bounds: Bounds | None = None) -> None:
        """Nothing seen yet."""
        self._bounds = bounds or Bounds()
        self._last: dict[str, SceneObject] = {}
        self._stamp = -np.inf
        self._moving = self._frozen = False
        self._repetition = Repetition()

    def update(self, scene: Scene) -> int:
        """`Condition` bits of a new scene; 0 means that it is believed, and that the next is compared with it."""
        if not (_finite(scene) and all(self._possible(thing, scene.stamp) for thing in scene.objects)):
            return Condition.SCENE_IMPLAUSIBLE
        self._frozen = self._repetition.update(map(_sighting, scene.objects)) >= self._bounds.scene_frozen
        if self._frozen:
            return Condition.SCENE_FROZEN
        self._last = {thing.name: thing for thing in scene.objects}
        self._stamp = scene.stamp
        self._moving = any(
            thing.role == "person" or thing.velocity != STILL or thing.velocity_error > 0.0 for thing in scene.objects
        )
        return 0

    def age(self, scene: Scene, now: float) -> int:
        """`Condition` bits of the scene in force at `now` [s]; a scene in which nothing moves may be old."""
        frozen = int(Condition.SCENE_FROZEN) if self._frozen else 0
        age = now - believed(scene)
        if not age >= -self._bounds.scene_ahead:
            return frozen | Condition.SCENE_IMPLAUSIBLE
        if not self._moving or age <= self._bounds.scene_old:
            return frozen
        return frozen | Condition.SCENE_OLD | (Condition.SCENE_STALE if age > self._bounds.scene_stale else 0)

    def _possible(self, thing: SceneObject, stamp: float) -> bool:
        """Whether `thing` can have come from where it was last."""
        last = self._last.get(thing.name)
        if last is None:
            return True
        moved = float(np.linalg.norm(np.subtract(thing.pose.position, last.pose.position)))
        noise = thing.error + last.error + SLACK
        if thing.role in FIXED:
            return moved <= noise
        return moved <= noise + FASTEST * max(0.0, max(stamp, thing.stamp) - min(self._stamp, last.stamp))


def _sighting(thing: SceneObject) -> Sighting:
    numbers = (thing.pose, thing.velocity)
    return Sighting(thing.name, thing.stamp, numbers, exact=thing.error == 0.0 and thing.velocity_error == 0.0)


def _finite(scene: Scene) -> bool:
    numbers = [
        value
        for thing in scene.objects
        for value in (
            *thing.pose.position, *thing.pose.quaternion, *thing.velocity, thing.error, thing.velocity_error,
            thing.stamp,
        )
    ]  # fmt: skip
    return bool(np.isfinite(np.array([scene.stamp, *numbers])).all())
