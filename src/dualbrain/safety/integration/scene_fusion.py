"""Fusion of objects from several sources, each with its own frame, age and error, into the obstacles of a filter.

Reports become obstacles in the world, extrapolated to the current time. The margin is the sum of the errors of shape
and source, error + angle × distance for each frame, and velocity error × age. The distance is that of the farthest
point of the shape. A half-space has none, so it is rejected in a frame whose angle has an error. The angle also adds to
the velocity error. An implausible report is rejected with its reason and changes nothing. If a required source is
silent beyond its limit, the robot stops.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from math import inf, isfinite, nan

import msgspec
import numpy as np

from dualbrain.core.geometry import validation
from dualbrain.core.geometry.distance import Solid, bounding_solid
from dualbrain.core.geometry.rotations import matrix_to_quaternion, quaternion_to_matrix
from dualbrain.core.geometry.shapes import Box, Capsule, HalfSpace, Pose, Quaternion, Shape, Sphere, Vector
from dualbrain.errors import ConfigurationError, GeometryError, UnknownNameError
from dualbrain.records import ZERO_VECTOR
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.safety.cbf.kernel import MAX_OBSTACLES
from dualbrain.safety.cbf.obstacles import Obstacle
from dualbrain.safety.cbf.rows import Rank
from dualbrain.safety.supervisor.frozen_sensor import FrozenSensorDetector, SensorReading

WORLD = "world"
SILENT_SOURCE_DISTANCE = 1000.0
"""Distance of the placeholder of a silent source [m]; it causes no row, but its age stops the robot."""


class SceneSource(msgspec.Struct, frozen=True, kw_only=True):
    """One sensor or map: position `error` [m] of everything it reports, and `max_age` [s] of its reports.

    A source that is not `required` may be silent: its last report is dropped at `max_age`. Measurements are noisy, so
    a source that reports a shape with an error bit for bit `max_repeats` times with new stamps is frozen and is
    rejected. None disables this check, e.g. for a map.

    A report that is older than the one before is rejected, because it would replace newer shapes. With `in_order` False
    it is accepted, and counts from its own stamp: the source has several sensors, and every report contains what all of
    them have seen until it was made.
    """

    error: float
    max_age: float
    required: bool = True
    max_repeats: int | None = 3
    in_order: bool = True


class FrameMount(msgspec.Struct, frozen=True, kw_only=True):
    """Pose of a frame in its `parent`, known to `error` [m] and `angle_error` [rad].

    `SceneFusion.set_frame_pose` moves a frame. The frame then applies to reports whose stamp is within
    `time_tolerance` [s] of the pose.
    """

    pose: Pose = Pose((0.0, 0.0, 0.0))
    parent: str = WORLD
    error: float = 0.0
    angle_error: float = 0.0
    time_tolerance: float = inf


class PerceivedShape(msgspec.Struct, frozen=True, kw_only=True):
    """One shape with velocity, in the frame of its source; errors in m and m/s. `person` marks people."""

    name: str
    shape: Shape
    pose: Pose
    velocity: Vector = ZERO_VECTOR
    error: float = 0.0
    velocity_error: float = 0.0
    person: bool = False


@dataclass(frozen=True, slots=True)
class SourceAccepted:
    """A report of `source` with `count` shapes was accepted."""

    source: str
    count: int


@dataclass(frozen=True, slots=True)
class SourceRefused:
    """A report of `source` was rejected for `reason`; the previous report stays in force and ages."""

    source: str
    reason: str


@dataclass(frozen=True, slots=True)
class _SourceReport:
    stamp: float
    obstacles: tuple[Obstacle, ...]


class SceneFusion:
    """Fuses the last reports of all sources into obstacles for one filter."""

    def __init__(self, sources: Mapping[str, SceneSource], frames: Mapping[str, FrameMount] | None = None) -> None:
        """Accept reports of these sources, in these frames and in "world".

        Raises:
            UnknownNameError: the parent of a frame is not known.
            ConfigurationError: the frames form a cycle, or an error or age is negative or not finite.
        """
        self._sources, self._frames = dict(sources), {WORLD: FrameMount(), **(frames or {})}
        self._frame_stamps = dict.fromkeys(self._frames, -inf)
        self._reports: dict[str, _SourceReport] = {}
        self._frozen_detectors = {name: FrozenSensorDetector() for name in self._sources}
        for name, source in self._sources.items():
            validation.check_length(f"error of source {name!r}", source.error)
            validation.check_positive(f"max_age of source {name!r}", source.max_age)
        for name in self._frames:
            self._check_frame(name)

    def set_frame_pose(self, frame: str, pose: Pose, stamp: float) -> None:
        """Set the pose of a frame in its parent at `stamp` [s].

        Raises:
            UnknownNameError: there is no such frame.
            GeometryError: the pose or the stamp is not usable; reports in this frame are then rejected.
        """
        if frame not in self._frames or frame == WORLD:
            raise UnknownNameError("frame", frame, tuple(self._frames))
        self._frame_stamps[frame] = nan
        usable = validation.check_pose(f"pose of frame {frame!r}", pose)
        self._frames[frame] = msgspec.structs.replace(self._frames[frame], pose=usable)
        self._frame_stamps[frame] = validation.check_stamp(f"stamp of frame {frame!r}", stamp)

    def update(
        self, source: str, frame: str, stamp: float, primitives: Iterable[PerceivedShape], *, now: float
    ) -> SourceAccepted | SourceRefused:
        """Replace the report of `source` by `primitives`, measured in `frame` at `stamp` [s]; the time is `now` [s]."""
        try:
            shapes = validation.check_sequence("report", primitives, MAX_OBSTACLES, of="shapes")
        except GeometryError as error:
            return SourceRefused(source, str(error))
        why = self._rejection_reason(source, frame, stamp, shapes, now) or self._frozen_reason(source, stamp, shapes)
        if why:
            return SourceRefused(source, why)
        obstacles = tuple(self._obstacle(source, frame, shape) for shape in shapes)
        others = sum(len(report.obstacles) for name, report in self._reports.items() if name != source)
        if others + len(obstacles) + len(self._sources) > MAX_OBSTACLES:
            return SourceRefused(
                source, f"{len(obstacles)} shapes and {others} of other sources exceed the limit of {MAX_OBSTACLES}"
            )
        self._reports[source] = _SourceReport(stamp, obstacles)
        return SourceAccepted(source, len(obstacles))

    def silent_sources(self, now: float) -> tuple[str, ...]:
        """Required sources that have not reported or whose last report is too old."""
        return tuple(
            name
            for name, source in self._sources.items()
            if source.required and not now - self._stamp(name) <= source.max_age
        )

    def obstacles(self, now: float) -> tuple[Obstacle, ...]:
        """All obstacles at `now` [s], extrapolated along their velocity, at most by the `max_age` of their source.

        Raises `GeometryError` if `now` is not finite.
        """
        validation.check_stamp("now of the scene fusion", now)
        current: list[Obstacle] = []
        for name, report in self._reports.items():
            source, age = self._sources[name], max(0.0, now - report.stamp)
            if source.required or age <= source.max_age:
                age = min(age, source.max_age)  # a silent source stops the robot
                current += [_extrapolate(obstacle, age) for obstacle in report.obstacles]
        return tuple(current)

    def apply_to(self, safety: SafetyFilter, now: float) -> tuple[str, ...]:
        """Pass the scene at `now` [s] to `safety`. Returns the silent sources; if there are any, the robot stops."""
        silent, current = self.silent_sources(now), self.obstacles(now)
        placeholders = tuple(
            Obstacle(
                name=f"{name} is silent",
                shape=Sphere(1e-3),
                pose=Pose((0.0, 0.0, SILENT_SOURCE_DISTANCE)),
                static=False,
            )
            for name in silent
        )
        delay = 2.0 * safety.config.scene_stale_after if silent else 0.0
        safety.observe((*current, *placeholders), now - delay)
        return silent

    # --- plausibility -------------------------------------------------------------------------------------------

    def _rejection_reason(
        self, source: str, frame: str, stamp: float, shapes: Sequence[PerceivedShape], now: float
    ) -> str:
        """Why a report is implausible, or ""."""
        if source not in tuple(self._sources):
            return f"source {source!r} is unknown; known: {', '.join(self._sources)}"
        if frame not in tuple(self._frames):
            return f"frame {frame!r} is unknown; known: {', '.join(self._frames)}"
        return self._time_reason(source, frame, stamp, now) or _shape_reason(shapes) or self._tilt_reason(frame, shapes)

    def _frozen_reason(self, source: str, stamp: float, shapes: Sequence[PerceivedShape]) -> str:
        """Why a report is frozen, or "". Shapes without any error are exempt, because they are not measured."""
        error, allowed = self._sources[source].error, self._sources[source].max_repeats
        repeats = self._frozen_detectors[source].update(
            SensorReading(shape.name, stamp, shape, noise_free=error + shape.error + shape.velocity_error == 0.0)
            for shape in shapes
        )
        if allowed is None or repeats < allowed:
            return ""
        return (
            f"{repeats} reports in a row are identical bit for bit: the source is frozen (for a map: max_repeats=None)"
        )

    def _time_reason(self, source: str, frame: str, stamp: float, now: float) -> str:
        """Why the stamp is implausible, or ""; the comparisons reject NaN."""
        if not (validation.is_real(stamp) and validation.is_real(now) and isfinite(stamp) and stamp <= now):
            return f"stamp {stamp} s is not finite or after the current time {now} s"
        if not now - stamp <= self._sources[source].max_age:
            return f"age {now - stamp:.3f} s exceeds the limit of {self._sources[source].max_age} s"
        if self._sources[source].in_order and stamp < self._stamp(source):
            return f"stamp {stamp} s is before the last stamp {self._stamp(source)} s"
        for name in self._frame_chain(frame):
            if not abs(stamp - self._frame_stamps[name]) <= self._frames[name].time_tolerance:
                return f"the pose of frame {name!r} at {self._frame_stamps[name]} s is too far in time from {stamp} s"
        return ""

    def _tilt_reason(self, frame: str, shapes: Sequence[PerceivedShape]) -> str:
        """Which half-space is in a frame whose angle has an error, which no margin covers at a distance; or ""."""
        angle = sum(self._frames[name].angle_error for name in self._frame_chain(frame))
        for shape in shapes:
            if angle > 0.0 and isinstance(shape.shape, HalfSpace):
                return (
                    f"{shape.name!r}: the angle of the frame {frame!r} is known to {angle:g} rad, so the error of a "
                    f"half-space in it has no bound; state the plane in the frame {WORLD!r} of the robot base, in "
                    "another frame without angle_error, or as a box"
                )
        return ""

    def _stamp(self, source: str) -> float:
        return self._reports[source].stamp if source in self._reports else -inf

    def _frame_chain(self, frame: str) -> list[str]:
        """The frame and its parents below the world."""
        chain: list[str] = []
        while frame != WORLD:
            chain.append(frame)
            frame = self._frames[frame].parent
        return chain

    def _check_frame(self, name: str) -> None:
        seen: list[str] = []
        while name != WORLD:
            if name in seen:
                raise ConfigurationError("frames", got=" in ".join([*seen, name]), allowed="frames without a cycle")
            if name not in self._frames:
                raise UnknownNameError("frame", name, tuple(self._frames))
            mount = self._frames[name]
            validation.check_pose(f"pose of frame {name!r}", mount.pose)
            validation.check_length(f"error of frame {name!r}", mount.error)
            validation.check_length(f"angle_error of frame {name!r}", mount.angle_error)
            if not validation.check_real(f"time_tolerance of frame {name!r}", mount.time_tolerance) >= 0.0:
                raise GeometryError(f"time_tolerance of frame {name!r}", got=mount.time_tolerance, allowed="0 or more")
            seen.append(name)
            name = mount.parent

    # --- transformation to the world ----------------------------------------------------------------------------

    def _obstacle(self, source: str, frame: str, perceived: PerceivedShape) -> Obstacle:
        shape, pose = bounding_solid(perceived.shape, perceived.pose)
        margin, velocity_error = perceived.error + self._sources[source].error, perceived.velocity_error
        velocity, extent = np.array(perceived.velocity), _extent(shape)
        for name in self._frame_chain(frame):
            mount = self._frames[name]
            margin += mount.error + mount.angle_error * (float(np.linalg.norm(pose.position)) + extent)
            velocity_error += mount.angle_error * float(np.linalg.norm(velocity))
            velocity = quaternion_to_matrix(mount.pose.quaternion) @ velocity
            pose = _compose(mount.pose, pose)
        x, y, z = (float(part) for part in velocity)
        moves = perceived.person or perceived.velocity != ZERO_VECTOR or perceived.velocity_error > 0.0
        return Obstacle(
            name=f"{source}/{perceived.name}",
            shape=shape,
            pose=pose,
            velocity=(x, y, z),
            margin=margin,
            velocity_error=velocity_error,
            static=not moves,
            rank=Rank.BODY if perceived.person else Rank.OBSTACLE,
        )


def _extent(shape: Solid) -> float:
    """Largest distance [m] from the centre of `shape` of a point that a rotation moves; 0 for a sphere."""
    match shape:
        case Capsule():
            return shape.half_length
        case Box():
            return float(np.linalg.norm(shape.half_extents))
        case _:
            return 0.0


def _extrapolate(obstacle: Obstacle, age: float) -> Obstacle:
    x, y, z = (p + v * age for p, v in zip(obstacle.pose.position, obstacle.velocity, strict=True))
    pose = Pose((x, y, z), obstacle.pose.quaternion)
    return msgspec.structs.replace(obstacle, pose=pose, margin=obstacle.margin + obstacle.velocity_error * age)


def _compose(outer: Pose, inner: Pose) -> Pose:
    """The pose `inner`, given in the frame at `outer`, in the parent of that frame."""
    rotation = quaternion_to_matrix(outer.quaternion)
    x, y, z = (float(value) for value in rotation @ np.array(inner.position) + np.array(outer.position))
    quaternion: Quaternion = matrix_to_quaternion(rotation @ quaternion_to_matrix(inner.quaternion))
    return Pose((x, y, z), quaternion)


def _shape_reason(shapes: Sequence[PerceivedShape]) -> str:
    """Which shape is implausible, and why, or ""."""
    for index, shape in enumerate(shapes):
        if why := _number_reason(shape):
            return f"{getattr(shape, 'name', index)!r}: {why}"
    names = [shape.name for shape in shapes]
    return "a name occurs twice" if len(set(names)) != len(names) else ""


def _number_reason(perceived: PerceivedShape) -> str:
    """Why a shape is not usable, or ""."""
    try:
        validation.check_instance("shape", perceived, PerceivedShape)
        validation.check_name("name", perceived.name)
        validation.check_shape("shape", perceived.shape)
        validation.check_pose("pose", perceived.pose)
        validation.check_velocity("velocity", perceived.velocity)
        validation.check_length("error", perceived.error)
        validation.check_length("velocity_error", perceived.velocity_error, validation.MAX_SPEED)
        validation.check_flag("person", perceived.person)
    except GeometryError as error:
        return str(error)
    return ""
