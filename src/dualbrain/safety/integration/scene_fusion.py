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

from dualbrain.core.geometry.distance import solid
from dualbrain.core.geometry.rotations import matrix, quaternion
from dualbrain.core.geometry.shapes import Pose, Quaternion, Shape, Sphere, Vector
from dualbrain.errors import InvalidSetup, UnknownName
from dualbrain.records import STILL
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.safety.cbf.kernel import MOST_OBSTACLES
from dualbrain.safety.cbf.obstacles import Obstacle
from dualbrain.safety.cbf.rows import Rank
from dualbrain.safety.supervisor.frozen_sensor import Repetition, Sighting

WORLD = "world"
FAR = 1000.0
"""Where the token of a silent source stands [m]: it makes no row, its age alone stops the robot."""


class Source(msgspec.Struct, frozen=True):
    """One sensor or map: `error` [m] of every position it tells, `oldest` [s] that it may be believed.

    A source that is not `required` may stay silent: what it told last is dropped when it has become too old. What is
    measured has noise: where something with an error comes again, equal to the bit and stamped anew, so often in a row
    as `repeats`, the source hangs and is refused. None for one that may tell the same for ever, such as a map.
    """

    error: float
    oldest: float
    required: bool = True
    repeats: int | None = 3


class Mounted(msgspec.Struct, frozen=True):
    """Where a frame is in its parent: `pose`, known to `error` [m] and `angle` [rad].

    A frame that moves is placed anew by `SceneFeed.place`; it may then be used for what was seen within `slack` [s].
    """

    pose: Pose = Pose((0.0, 0.0, 0.0))
    parent: str = WORLD
    error: float = 0.0
    angle: float = 0.0
    slack: float = inf


class Primitive(msgspec.Struct, frozen=True):
    """One shape as its source sees it, in the source's frame; velocities in that frame too, `person` if it is one."""

    name: str
    shape: Shape
    pose: Pose
    velocity: Vector = STILL
    error: float = 0.0
    velocity_error: float = 0.0
    person: bool = False


@dataclass(frozen=True, slots=True)
class Updated:
    """What a source told was taken over."""

    source: str
    count: int


@dataclass(frozen=True, slots=True)
class Refused:
    """What a source told was not taken over, and why; what it told before stays, and grows old."""

    source: str
    reason: str


@dataclass(frozen=True, slots=True)
class _Told:
    stamp: float
    obstacles: tuple[Obstacle, ...]


class SceneFeed:
    """Everything that the sources told last, as obstacles for one filter."""

    def __init__(self, sources: Mapping[str, Source], frames: Mapping[str, Mounted] | None = None) -> None:
        """Only these sources are heard, in these frames and "world".

        Raises:
            UnknownName: a frame's parent is not known.
            InvalidSetup: frames hang on each other in a circle, or a bound is negative or not finite.
        """
        self._sources, self._frames = dict(sources), {WORLD: Mounted(), **(frames or {})}
        self._placed = dict.fromkeys(self._frames, -inf)
        self._told: dict[str, _Told] = {}
        self._repetition = {name: Repetition() for name in self._sources}
        for name, source in self._sources.items():
            if not (0.0 <= source.error < inf and 0.0 < source.oldest < inf):
                raise InvalidSetup(f"source {name!r}", got=source, allowed="error of 0 or more, oldest above 0, finite")
        for name in self._frames:
            self._check_frame(name)

    def place(self, frame: str, pose: Pose, stamp: float) -> None:
        """A frame that moves was at `pose` in its parent at `stamp` [s]; raises `UnknownName`."""
        if frame not in self._frames or frame == WORLD:
            raise UnknownName("frame", frame, tuple(self._frames))
        self._frames[frame] = msgspec.structs.replace(self._frames[frame], pose=pose)
        self._placed[frame] = stamp

    def update(
        self, source: str, frame: str, stamp: float, primitives: Iterable[Primitive], *, now: float
    ) -> Updated | Refused:  # fmt: skip
        """Replace what `source` told by `primitives`, seen in `frame` at `stamp` [s]; it is `now` [s]."""
        shapes = tuple(primitives)
        why = self._doubt(source, frame, stamp, shapes, now) or self._frozen(source, stamp, shapes)
        if why:
            return Refused(source, why)
        obstacles = tuple(self._obstacle(source, frame, shape) for shape in shapes)
        others = sum(len(told.obstacles) for name, told in self._told.items() if name != source)
        if others + len(obstacles) + len(self._sources) > MOST_OBSTACLES:
            return Refused(
                source, f"{len(obstacles)} shapes beside {others} others: there is room for {MOST_OBSTACLES}"
            )
        self._told[source] = _Told(stamp, obstacles)
        return Updated(source, len(obstacles))

    def silent(self, now: float) -> tuple[str, ...]:
        """Required sources whose last word is too old, or that never spoke."""
        return tuple(
            name for name, source in self._sources.items()
            if source.required and not now - self._stamp(name) <= source.oldest
        )  # fmt: skip

    def obstacles(self, now: float) -> tuple[Obstacle, ...]:
        """Everything that is believed at `now` [s], carried forward along its velocity."""
        believed: list[Obstacle] = []
        for name, told in self._told.items():
            age = max(0.0, now - told.stamp)
            if self._sources[name].required or age <= self._sources[name].oldest:
                believed += [_aged(obstacle, age) for obstacle in told.obstacles]
        return tuple(believed)

    def hand_over(self, safety: SafetyFilter, now: float) -> tuple[str, ...]:
        """Give `safety` the scene of `now` [s]; returns the silent sources, while there is one the robot stops."""
        silent, believed = self.silent(now), self.obstacles(now)
        tokens = tuple(
            Obstacle(f"{name} is silent", Sphere(1e-3), Pose((0.0, 0.0, FAR)), static=False) for name in silent
        )
        late = 2.0 * safety.config.stale_after if silent else 0.0
        safety.observe((*believed, *tokens), now - late)
        return silent

    # --- doubts -------------------------------------------------------------------------------------------------

    def _doubt(self, source: str, frame: str, stamp: float, shapes: Sequence[Primitive], now: float) -> str:
        """Why this cannot be believed, or nothing."""
        if source not in self._sources:
            return f"source {source!r} is not known; known: {', '.join(self._sources)}"
        if frame not in self._frames:
            return f"frame {frame!r} is not known; known: {', '.join(self._frames)}"
        return self._late(source, frame, stamp, now) or _misshapen(shapes)

    def _frozen(self, source: str, stamp: float, shapes: Sequence[Primitive]) -> str:
        """Why this is no new picture. Shapes without any error are exempt: they are not measured."""
        error, allowed = self._sources[source].error, self._sources[source].repeats
        again = self._repetition[source].update(
            Sighting(seen.name, stamp, seen, exact=error + seen.error + seen.velocity_error == 0.0) for seen in shapes
        )
        if allowed is None or again < allowed:
            return ""
        return f"equal to the bit for {again} pictures in a row: it hangs (a map says Source(repeats=None))"

    def _late(self, source: str, frame: str, stamp: float, now: float) -> str:
        """Why the time cannot be believed; written so that NaN is refused."""
        if not (isfinite(stamp) and stamp <= now):
            return f"stamp {stamp} s lies in the future of {now} s, or is no time"
        if not now - stamp <= self._sources[source].oldest:
            return f"{now - stamp:.3f} s old, at most {self._sources[source].oldest} s are believed"
        if stamp < self._stamp(source):
            return f"stamp {stamp} s is older than the last one, {self._stamp(source)} s"
        for name in self._up(frame):
            if not abs(stamp - self._placed[name]) <= self._frames[name].slack:
                return f"frame {name!r} was placed at {self._placed[name]} s, too far from {stamp} s"
        return ""

    def _stamp(self, source: str) -> float:
        return self._told[source].stamp if source in self._told else -inf

    def _up(self, frame: str) -> list[str]:
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
                raise InvalidSetup("frames", got=" in ".join([*seen, name]), allowed="no circle")
            if name not in self._frames:
                raise UnknownName("frame", name, tuple(self._frames))
            mounted = self._frames[name]
            if not (0.0 <= mounted.error < inf and 0.0 <= mounted.angle < inf):
                raise InvalidSetup(f"frame {name!r}", got=mounted, allowed="error and angle of 0 or more, finite")
            seen.append(name)
            name = mounted.parent

    # --- into the world -----------------------------------------------------------------------------------------

    def _obstacle(self, source: str, frame: str, seen: Primitive) -> Obstacle:
        shape, pose = solid(seen.shape, seen.pose)
        margin = seen.error + self._sources[source].error
        velocity = np.array(seen.velocity)
        for name in self._up(frame):
            mounted = self._frames[name]
            margin += mounted.error + mounted.angle * float(np.linalg.norm(pose.position))
            velocity = matrix(mounted.pose.quaternion) @ velocity
            pose = _within(mounted.pose, pose)
        x, y, z = (float(part) for part in velocity)
        moves = seen.person or seen.velocity != STILL or seen.velocity_error > 0.0
        return Obstacle(
            f"{source}/{seen.name}", shape, pose, (x, y, z), margin, seen.velocity_error, static=not moves,
            rank=Rank.BODY if seen.person else Rank.OBSTACLE,
        )  # fmt: skip


def _aged(obstacle: Obstacle, age: float) -> Obstacle:
    x, y, z = (p + v * age for p, v in zip(obstacle.pose.position, obstacle.velocity, strict=True))
    pose = Pose((x, y, z), obstacle.pose.quaternion)
    return msgspec.structs.replace(obstacle, pose=pose, margin=obstacle.margin + obstacle.velocity_error * age)


def _within(outer: Pose, inner: Pose) -> Pose:
    """The pose `inner`, given in the frame at `outer`, in the frame around it."""
    turn = matrix(outer.quaternion)
    x, y, z = (float(value) for value in turn @ np.array(inner.position) + np.array(outer.position))
    turned: Quaternion = quaternion(turn @ matrix(inner.quaternion))
    return Pose((x, y, z), turned)


def _misshapen(shapes: Sequence[Primitive]) -> str:
    """Which shape cannot be believed, and why."""
    names = [shape.name for shape in shapes]
    if len(set(names)) != len(names):
        return "names that occur twice"
    return next((f"{shape.name!r}: {why}" for shape in shapes if (why := _fault(shape))), "")


def _fault(seen: Primitive) -> str:
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
