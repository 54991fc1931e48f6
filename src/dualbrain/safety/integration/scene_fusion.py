"""The scene as several sources tell it, each in its own frame, with its own age and error.

What is told becomes obstacles in the world, carried forward to now: margin = the primitive's error + its source's + its
frame's (error + angle × distance from the frame's origin) + velocity error × age. What cannot be believed is refused as
a value with its reason, and changes nothing. A source that falls silent beyond its limit stops the robot.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from math import inf, isfinite, nan

import msgspec
import numpy as np

from dualbrain.core.geometry.distance import bounding_solid
from dualbrain.core.geometry.rotations import matrix_to_quaternion, quaternion_to_matrix
from dualbrain.core.geometry.shapes import Pose, Quaternion, Shape, Sphere, Vector
from dualbrain.errors import ConfigurationError, UnknownNameError
from dualbrain.records import ZERO_VECTOR
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.safety.cbf.kernel import MAX_OBSTACLES
from dualbrain.safety.cbf.obstacles import Obstacle
from dualbrain.safety.cbf.rows import Rank
from dualbrain.safety.supervisor.frozen_sensor import FrozenSensorDetector, SensorReading

WORLD = "world"
SILENT_SOURCE_DISTANCE = 1000.0
"""Where the token of a silent source stands [m]: it makes no row, its age alone stops the robot."""


class SceneSource(msgspec.Struct, frozen=True):
    """One sensor or map: `error` [m] of every position it tells, `oldest` [s] that it may be believed.

    A source that is not `required` may stay silent: what it told last is dropped when it has become too old. What is
    measured has noise: where something with an error comes again, equal to the bit and stamped anew, so often in a row
    as `repeats`, the source hangs and is refused. None for one that may tell the same for ever, such as a map.
    """

    error: float
    max_age: float
    required: bool = True
    max_repeats: int | None = 3


class FrameMount(msgspec.Struct, frozen=True, kw_only=True):
    """Where a frame is in its parent: `pose`, known to `error` [m] and `angle` [rad].

    A frame that moves is placed anew by `SceneFeed.place`; it may then be used for what was seen within `slack` [s].
    """

    pose: Pose = Pose((0.0, 0.0, 0.0))
    parent: str = WORLD
    error: float = 0.0
    angle_error: float = 0.0
    time_tolerance: float = inf


class PerceivedShape(msgspec.Struct, frozen=True, kw_only=True):
    """One shape as its source sees it, in the source's frame; velocities in that frame too, `person` if it is one."""

    name: str
    shape: Shape
    pose: Pose
    velocity: Vector = ZERO_VECTOR
    error: float = 0.0
    velocity_error: float = 0.0
    person: bool = False


@dataclass(frozen=True, slots=True)
class SourceAccepted:
    """What a source told was taken over."""

    source: str
    count: int


@dataclass(frozen=True, slots=True)
class SourceRefused:
    """What a source told was not taken over, and why; what it told before stays, and grows old."""

    source: str
    reason: str


@dataclass(frozen=True, slots=True)
class _SourceReport:
    stamp: float
    obstacles: tuple[Obstacle, ...]


class SceneFusion:
    """Everything that the sources told last, as obstacles for one filter."""

    def __init__(self, sources: Mapping[str, SceneSource], frames: Mapping[str, FrameMount] | None = None) -> None:
        """Only these sources are heard, in these frames and "world".

        Raises:
            UnknownName: a frame's parent is not known.
            InvalidSetup: frames hang on each other in a circle, or a bound is negative or not finite.
        """
        self._sources, self._frames = dict(sources), {WORLD: FrameMount(), **(frames or {})}
        self._frame_stamps = dict.fromkeys(self._frames, -inf)
        self._reports: dict[str, _SourceReport] = {}
        self._frozen_detectors = {name: FrozenSensorDetector() for name in self._sources}
        for name, source in self._sources.items():
            if not (0.0 <= source.error < inf and 0.0 < source.max_age < inf):
                raise ConfigurationError(
                    f"source {name!r}", got=source, allowed="error of 0 or more, oldest above 0, finite"
                )
        for name in self._frames:
            self._check_frame(name)

    def set_frame_pose(self, frame: str, pose: Pose, stamp: float) -> None:
        """A frame that moves was at `pose` in its parent at `stamp` [s]; raises `UnknownName`."""
        if frame not in self._frames or frame == WORLD:
            raise UnknownNameError("frame", frame, tuple(self._frames))
        self._frames[frame] = msgspec.structs.replace(self._frames[frame], pose=pose)
        self._frame_stamps[frame] = stamp

    def update(
        self, source: str, frame: str, stamp: float, primitives: Iterable[PerceivedShape], *, now: float
    ) -> SourceAccepted | SourceRefused:
        """Replace what `source` told by `primitives`, seen in `frame` at `stamp` [s]; it is `now` [s]."""
        shapes = tuple(primitives)
        why = self._rejection_reason(source, frame, stamp, shapes, now) or self._frozen_reason(source, stamp, shapes)
        if why:
            return SourceRefused(source, why)
        obstacles = tuple(self._obstacle(source, frame, shape) for shape in shapes)
        others = sum(len(told.obstacles) for name, told in self._reports.items() if name != source)
        if others + len(obstacles) + len(self._sources) > MAX_OBSTACLES:
            return SourceRefused(
                source, f"{len(obstacles)} shapes beside {others} others: there is room for {MAX_OBSTACLES}"
            )
        self._reports[source] = _SourceReport(stamp, obstacles)
        return SourceAccepted(source, len(obstacles))

    def silent_sources(self, now: float) -> tuple[str, ...]:
        """Required sources whose last word is too old, or that never spoke."""
        return tuple(
            name
            for name, source in self._sources.items()
            if source.required and not now - self._stamp(name) <= source.max_age
        )

    def obstacles(self, now: float) -> tuple[Obstacle, ...]:
        """Everything that is believed at `now` [s], carried forward along its velocity."""
        believed: list[Obstacle] = []
        for name, told in self._reports.items():
            age = max(0.0, now - told.stamp)
            if self._sources[name].required or age <= self._sources[name].max_age:
                believed += [_extrapolate(obstacle, age) for obstacle in told.obstacles]
        return tuple(believed)

    def apply_to(self, safety: SafetyFilter, now: float) -> tuple[str, ...]:
        """Give `safety` the scene of `now` [s]; returns the silent sources, while there is one the robot stops."""
        silent, believed = self.silent_sources(now), self.obstacles(now)
        tokens = tuple(
            Obstacle(
                name=f"{name} is silent",
                shape=Sphere(1e-3),
                pose=Pose((0.0, 0.0, SILENT_SOURCE_DISTANCE)),
                static=False,
            )
            for name in silent
        )
        late = 2.0 * safety.config.scene_stale_after if silent else 0.0
        safety.observe((*believed, *tokens), now - late)
        return silent

    # --- doubts -------------------------------------------------------------------------------------------------

    def _rejection_reason(
        self, source: str, frame: str, stamp: float, shapes: Sequence[PerceivedShape], now: float
    ) -> str:
        """Why this cannot be believed, or nothing."""
        if source not in self._sources:
            return f"source {source!r} is not known; known: {', '.join(self._sources)}"
        if frame not in self._frames:
            return f"frame {frame!r} is not known; known: {', '.join(self._frames)}"
        return self._time_reason(source, frame, stamp, now) or _shape_reason(shapes)

    def _frozen_reason(self, source: str, stamp: float, shapes: Sequence[PerceivedShape]) -> str:
        """Why this is no new picture. Shapes without any error are exempt: they are not measured."""
        error, allowed = self._sources[source].error, self._sources[source].max_repeats
        again = self._frozen_detectors[source].update(
            SensorReading(seen.name, stamp, seen, noise_free=error + seen.error + seen.velocity_error == 0.0)
            for seen in shapes
        )
        if allowed is None or again < allowed:
            return ""
        return f"equal to the bit for {again} pictures in a row: it hangs (a map says Source(repeats=None))"

    def _time_reason(self, source: str, frame: str, stamp: float, now: float) -> str:
        """Why the time cannot be believed; written so that NaN is refused."""
        if not (isfinite(stamp) and stamp <= now):
            return f"stamp {stamp} s lies in the future of {now} s, or is no time"
        if not now - stamp <= self._sources[source].max_age:
            return f"{now - stamp:.3f} s old, at most {self._sources[source].max_age} s are believed"
        if stamp < self._stamp(source):
            return f"stamp {stamp} s is older than the last one, {self._stamp(source)} s"
        for name in self._frame_chain(frame):
            if not abs(stamp - self._frame_stamps[name]) <= self._frames[name].time_tolerance:
                return f"frame {name!r} was placed at {self._frame_stamps[name]} s, too far from {stamp} s"
        return ""

    def _stamp(self, source: str) -> float:
        return self._reports[source].stamp if source in self._reports else -inf

    def _frame_chain(self, frame: str) -> list[str]:
        """The frame and its parents below the world."""
        found: list[str] = []
        while frame != WORLD:
            found.append(frame)
            frame = self._frames[frame].parent
        return found

    def _check_frame(self, name: str) -> None:
        seen: list[str] = []
        while name != WORLD:
            if name in seen:
                raise ConfigurationError("frames", got=" in ".join([*seen, name]), allowed="no circle")
            if name not in self._frames:
                raise UnknownNameError("frame", name, tuple(self._frames))
            mounted = self._frames[name]
            if not (0.0 <= mounted.error < inf and 0.0 <= mounted.angle_error < inf):
                raise ConfigurationError(f"frame {name!r}", got=mounted, allowed="error and angle of 0 or more, finite")
            seen.append(name)
            name = mounted.parent

    # --- into the world -----------------------------------------------------------------------------------------

    def _obstacle(self, source: str, frame: str, seen: PerceivedShape) -> Obstacle:
        shape, pose = bounding_solid(seen.shape, seen.pose)
        margin = seen.error + self._sources[source].error
        velocity = np.array(seen.velocity)
        for name in self._frame_chain(frame):
            mounted = self._frames[name]
            margin += mounted.error + mounted.angle_error * float(np.linalg.norm(pose.position))
            velocity = quaternion_to_matrix(mounted.pose.quaternion) @ velocity
            pose = _compose(mounted.pose, pose)
        x, y, z = (float(part) for part in velocity)
        moves = seen.person or seen.velocity != ZERO_VECTOR or seen.velocity_error > 0.0
        return Obstacle(
            name=f"{source}/{seen.name}",
            shape=shape,
            pose=pose,
            velocity=(x, y, z),
            margin=margin,
            velocity_error=seen.velocity_error,
            static=not moves,
            rank=Rank.BODY if seen.person else Rank.OBSTACLE,
        )


def _extrapolate(obstacle: Obstacle, age: float) -> Obstacle:
    x, y, z = (p + v * age for p, v in zip(obstacle.pose.position, obstacle.velocity, strict=True))
    pose = Pose((x, y, z), obstacle.pose.quaternion)
    return msgspec.structs.replace(obstacle, pose=pose, margin=obstacle.margin + obstacle.velocity_error * age)


def _compose(outer: Pose, inner: Pose) -> Pose:
    """The pose `inner`, given in the frame at `outer`, in the frame around it."""
    turn = quaternion_to_matrix(outer.quaternion)
    x, y, z = (float(value) for value in turn @ np.array(inner.position) + np.array(outer.position))
    turned: Quaternion = matrix_to_quaternion(turn @ quaternion_to_matrix(inner.quaternion))
    return Pose((x, y, z), turned)


def _shape_reason(shapes: Sequence[PerceivedShape]) -> str:
    """Which shape cannot be believed, and why."""
    names = [shape.name for shape in shapes]
    if len(set(names)) != len(names):
        return "names that occur twice"
    return next((f"{shape.name!r}: {why}" for shape in shapes if (why := _number_reason(shape))), "")


def _number_reason(seen: PerceivedShape) -> str:
    """What is wrong with the numbers of a primitive, or nothing."""
    sizes = [_numbers(value) for value in msgspec.structs.astuple(seen.shape)]
    flat: list[float] = [number for size in sizes for number in size]
    numbers = [*flat, *seen.pose.position, *seen.pose.quaternion, *seen.velocity, seen.error, seen.velocity_error]
    if not all(map(isfinite, numbers)):
        return "a number that is not finite"
    if min([*flat, 1.0]) < 0.0 or seen.error < 0.0 or seen.velocity_error < 0.0:
        return "a size or error below zero"
    if not abs(sum(value * value for value in seen.pose.quaternion) - 1.0) < 1e-3:
        return "a quaternion whose length is not 1"
    return ""


def _numbers(value: object) -> tuple[float, ...]:
    """A size or a triple of sizes; what is neither counts as not finite."""
    match value:
        case bool():
            return (nan,)
        case int() | float():
            return (float(value),)
        case (float() | int() as x, float() | int() as y, float() | int() as z):
            return (float(x), float(y), float(z))
        case _:
            return (nan,)
