"""Plausibility and age checks of perceived scenes.

A scene is accepted only if its geometry is usable and its names differ (`check_scene`), no fixed object has moved, no
object has moved faster than `MAX_OBJECT_SPEED`, and no noisy measurement repeats bit for bit (a camera that hangs and
puts new stamps on an old image). The checks do not detect every fault of a single camera: a shift within these bounds,
or an old image with fresh noise, passes.
"""

from __future__ import annotations

from math import dist, inf

from dualbrain.errors import GeometryError
from dualbrain.records import Scene, SceneObject
from dualbrain.safety.cbf.obstacles import check_scene, moves
from dualbrain.safety.supervisor.conditions import Condition
from dualbrain.safety.supervisor.frozen_sensor import FrozenSensorDetector, SensorReading
from dualbrain.safety.supervisor.state_monitor import MonitorLimits

MAX_PERSON_UNSEEN_TIME = 0.5
"""Time [s] after which the position of an unseen person is unknown: the scene then counts as that old."""
FIXED_ROLES = ("support", "obstacle")
"""Roles of objects that do not move."""
MAX_OBJECT_SPEED = 2.5
"""Upper bound on the speed of any object [m/s]: a person's hand, an object that falls from a table."""
FIXED_TOLERANCE = 0.01
"""Apparent motion of a fixed object that is accepted beyond its error bound [m]."""


def effective_stamp(scene: Scene) -> float:
    """The stamp [s] that defines the scene's age: its own, or that of a person who has not been seen for too long.

    The position of an unseen person is extrapolated along the last velocity; after `MAX_PERSON_UNSEEN_TIME` the filter
    must stop instead.
    """
    seen = min((obj.stamp for obj in scene.objects if obj.role == "person"), default=scene.stamp)
    return scene.stamp if scene.stamp - seen < MAX_PERSON_UNSEEN_TIME else seen


class SceneMonitor:
    """Compares each scene with the last accepted one."""

    def __init__(self, limits: MonitorLimits | None = None) -> None:
        """Start without a scene; `limits` are by default those of `MonitorLimits()`."""
        self._limits = limits or MonitorLimits()
        self._last: dict[str, SceneObject] = {}
        self._stamp = -inf
        self._moving = self._frozen = False
        self._frozen_detector = FrozenSensorDetector()

    def update(self, scene: Scene) -> int:
        """`Condition` bits of a new scene; 0 if it is accepted, and the next scene is then compared with it."""
        if not (_is_usable(scene) and all(self._is_plausible(obj, scene.stamp) for obj in scene.objects)):
            return Condition.SCENE_IMPLAUSIBLE
        self._frozen = self._frozen_detector.update(map(_reading, scene.objects)) >= self._limits.max_identical_scenes
        if self._frozen:
            return Condition.SCENE_FROZEN
        self._last = {obj.name: obj for obj in scene.objects}
        self._stamp = scene.stamp
        self._moving = any(moves(obj) for obj in scene.objects)
        return 0

    def age_conditions(self, scene: Scene, now: float) -> int:
        """`Condition` bits for the age of `scene` at `now` [s]; a scene in which nothing moves may be old."""
        frozen = int(Condition.SCENE_FROZEN) if self._frozen else 0
        age = now - effective_stamp(scene)
        if not age >= -self._limits.max_scene_lead:
            return frozen | Condition.SCENE_IMPLAUSIBLE
        if not self._moving or age <= self._limits.scene_old_after:
            return frozen
        return frozen | Condition.SCENE_OLD | (Condition.SCENE_STALE if age > self._limits.scene_stale_after else 0)

    def _is_plausible(self, obj: SceneObject, stamp: float) -> bool:
        """Whether `obj` can have reached its position from the last accepted one."""
        last = self._last.get(obj.name)
        if last is None:
            return True
        moved = dist(obj.pose.position, last.pose.position)
        noise = obj.error + last.error + FIXED_TOLERANCE
        if obj.role in FIXED_ROLES:
            return moved <= noise
        return moved <= noise + MAX_OBJECT_SPEED * max(0.0, max(stamp, obj.stamp) - min(self._stamp, last.stamp))


def _reading(obj: SceneObject) -> SensorReading:
    numbers = (obj.pose, obj.velocity)
    return SensorReading(obj.name, obj.stamp, numbers, noise_free=obj.error == 0.0 and obj.velocity_error == 0.0)


def _is_usable(scene: Scene) -> bool:
    """Whether all numbers are within bounds, no object is newer than the scene, and no name is used twice."""
    try:
        check_scene(scene)
    except GeometryError:
        return False
    return True
