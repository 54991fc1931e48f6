"""What a perceived scene says of itself: how old it is, and whether it can be at all.

A scene is believed only if its numbers are finite, what is fixed has not moved, nothing has gone faster than anything
here can, and what is seen with an error is not seen again and again equal to the bit (a camera that hangs and stamps
its old picture anew). One camera can lie in ways that this does not see: a shift within these bounds, or an old picture
with fresh noise.
"""

from __future__ import annotations

import numpy as np

from dualbrain.records import ZERO_VECTOR, Scene, SceneObject
from dualbrain.safety.supervisor.conditions import Condition
from dualbrain.safety.supervisor.frozen_sensor import FrozenSensorDetector, SensorReading
from dualbrain.safety.supervisor.state_monitor import MonitorLimits

MAX_PERSON_UNSEEN_TIME = 0.5
"""A person who was not seen for this long [s] may be anywhere: the filter is told that its scene is that old."""
FIXED_ROLES = ("support", "obstacle")
"""Roles of things that stay where they are."""
MAX_OBJECT_SPEED = 2.5
"""Nothing that moves here is faster than this [m/s]: a person's hand, a thing that falls from a table."""
FIXED_TOLERANCE = 0.01
"""What a fixed thing may seem to move beyond its error bound [m]."""


def effective_stamp(scene: Scene) -> float:
    """The stamp [s] to judge the scene's age by: its own, or that of a person who has not been seen for too long.

    A person is carried forward along the last velocity for a while; after `MISSED` the filter must stop instead.
    """
    seen = min((thing.stamp for thing in scene.objects if thing.role == "person"), default=scene.stamp)
    return scene.stamp if scene.stamp - seen < MAX_PERSON_UNSEEN_TIME else seen


class SceneMonitor:
    """Compares each scene with the last one that was believed."""

    def __init__(self, limits: MonitorLimits | None = None) -> None:
        """Nothing seen yet."""
        self._limits = limits or MonitorLimits()
        self._last: dict[str, SceneObject] = {}
        self._stamp = -np.inf
        self._moving = self._frozen = False
        self._frozen_detector = FrozenSensorDetector()

    def update(self, scene: Scene) -> int:
        """`Condition` bits of a new scene; 0 means that it is believed, and that the next is compared with it."""
        if not (_is_finite(scene) and all(self._is_plausible(thing, scene.stamp) for thing in scene.objects)):
            return Condition.SCENE_IMPLAUSIBLE
        self._frozen = self._frozen_detector.update(map(_sighting, scene.objects)) >= self._limits.max_identical_scenes
        if self._frozen:
            return Condition.SCENE_FROZEN
        self._last = {thing.name: thing for thing in scene.objects}
        self._stamp = scene.stamp
        self._moving = any(
            thing.role == "person" or thing.velocity != ZERO_VECTOR or thing.velocity_error > 0.0
            for thing in scene.objects
        )
        return 0

    def age_conditions(self, scene: Scene, now: float) -> int:
        """`Condition` bits of the scene in force at `now` [s]; a scene in which nothing moves may be old."""
        frozen = int(Condition.SCENE_FROZEN) if self._frozen else 0
        age = now - effective_stamp(scene)
        if not age >= -self._limits.max_scene_lead:
            return frozen | Condition.SCENE_IMPLAUSIBLE
        if not self._moving or age <= self._limits.scene_old_after:
            return frozen
        return frozen | Condition.SCENE_OLD | (Condition.SCENE_STALE if age > self._limits.scene_stale_after else 0)

    def _is_plausible(self, thing: SceneObject, stamp: float) -> bool:
        """Whether `thing` can have come from where it was last."""
        last = self._last.get(thing.name)
        if last is None:
            return True
        moved = float(np.linalg.norm(np.subtract(thing.pose.position, last.pose.position)))
        noise = thing.error + last.error + FIXED_TOLERANCE
        if thing.role in FIXED_ROLES:
            return moved <= noise
        return moved <= noise + MAX_OBJECT_SPEED * max(0.0, max(stamp, thing.stamp) - min(self._stamp, last.stamp))


def _sighting(thing: SceneObject) -> SensorReading:
    numbers = (thing.pose, thing.velocity)
    return SensorReading(
        thing.name, thing.stamp, numbers, noise_free=thing.error == 0.0 and thing.velocity_error == 0.0
    )


def _is_finite(scene: Scene) -> bool:
    numbers = [
        value
        for thing in scene.objects
        for value in (
            *thing.pose.position,
            *thing.pose.quaternion,
            *thing.velocity,
            thing.error,
            thing.velocity_error,
            thing.stamp,
        )
    ]
    return bool(np.isfinite(np.array([scene.stamp, *numbers])).all())
