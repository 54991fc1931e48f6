"""Depth images and point clouds as a source of obstacles for `SceneFusion`.

Points on the robot itself are removed: those within `self_margin` of its collision spheres. The filter keeps everything
that was seen farther away than that, because the boxes have this margin, so that a removed point is the robot or has
come to the robot by itself. A depth image without enough valid pixels, or one that repeats bit for bit, is refused; the
report before it stays in force and ages, until the filter stops the robot (`SceneSource.max_age`).
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from math import inf
from time import perf_counter

import msgspec
import numpy as np
from numpy.typing import ArrayLike, NDArray

from dualbrain.core.geometry import validation
from dualbrain.core.geometry.distance import signed_distance
from dualbrain.core.geometry.rotations import quaternion_to_matrix
from dualbrain.core.geometry.shapes import Box, Pose, Vector
from dualbrain.errors import GeometryError, UnknownNameError
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.safety.cbf.obstacles import Obstacle
from dualbrain.safety.integration.point_clouds.box_cover import BoxCover, cover_voxels
from dualbrain.safety.integration.point_clouds.occupancy_grid import OccupancyGrid
from dualbrain.safety.integration.point_clouds.pinhole_camera import PinholeCamera
from dualbrain.safety.integration.scene_fusion import PerceivedShape, SceneSource
from dualbrain.safety.supervisor.frozen_sensor import FrozenSensorDetector, SensorReading

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
MAX_POINTS = 2_000_000
"""Largest number of points of one cloud."""
ONLY_SENSOR = "camera"
"""Name of the sensor of a source with one."""


class PointCloudConfig(msgspec.Struct, frozen=True, kw_only=True):
    """Configuration of one source. Lengths are in m, speeds in m/s.

    - `lower`, `upper`: corners of the observed box in the world; nothing outside is seen. It must contain everything
      that the robot can reach.
    - `voxel`: side of a voxel. `error`: bound of the error of a measured point, with that of the pose of the sensor.
    - `self_margin`: points this close to the robot's collision spheres are the robot. It covers `error` and the error
      of the collision model at the measured joint angles.
    - `speed`: bound of the speed of things between two reports; `person_speed` for points marked as people.
    - `max_boxes`, `max_person_boxes`: number of obstacles that contain the voxels, and those of people.
    - `unknown_is_occupied`: the surface of space that no sensor has seen counts as occupied. `memory` [s]: time after
      which free space that is not seen becomes unknown. `free_at_start`: space this close to the robot counts as free
      at the first frame, because the arm hides some of it; a person must have looked.
    - `min_points`: measured points that make a voxel occupied; more than 1 ignores single outliers, and small things.
    - `min_valid_share`: share of the pixels of a depth image that must hold a measurement.
    - `max_repeats`: number of equal depth images in a row that is still accepted; a measurement is never equal.
    - `max_lag` [s]: time by which the last frame of one sensor may be older than that of another one.
    """

    lower: Vector
    upper: Vector
    voxel: float = 0.02
    error: float = 0.005
    self_margin: float = 0.02
    speed: float = 0.0
    person_speed: float = 1.6
    max_boxes: int = 48
    max_person_boxes: int = 8
    unknown_is_occupied: bool = False
    memory: float = inf
    free_at_start: float = 0.0
    min_points: int = 1
    min_valid_share: float = 0.3
    max_repeats: int = 3
    max_lag: float = 0.5

    def __post_init__(self) -> None:
        """Check the values; raises `GeometryError`."""
        for name in ("error", "self_margin", "free_at_start"):
            validation.check_length(f"PointCloudConfig.{name} [m]", getattr(self, name), 1.0)
        for name in ("speed", "person_speed"):
            validation.check_length(f"PointCloudConfig.{name} [m/s]", getattr(self, name), validation.MAX_SPEED)
        for name in ("max_boxes", "max_person_boxes", "min_points", "max_repeats"):
            value = getattr(self, name)
            if type(value) is not int or not 0 < value <= MAX_POINTS:
                raise GeometryError(f"PointCloudConfig.{name}", got=value, allowed="a whole number of 1 or more")
        validation.check_number("PointCloudConfig.min_valid_share", self.min_valid_share, 0.0, 1.0)
        validation.check_positive("PointCloudConfig.max_lag [s]", self.max_lag)
        validation.check_flag("PointCloudConfig.unknown_is_occupied", self.unknown_is_occupied)
        if not validation.check_real("PointCloudConfig.memory [s]", self.memory) >= 0.0:
            raise GeometryError("PointCloudConfig.memory [s]", got=self.memory, allowed="0 or more")
        if self.self_margin < self.error:
            name, fix = "PointCloudConfig.self_margin [m]", "Points on the robot itself would count as obstacles."
            raise GeometryError(name, got=self.self_margin, allowed=f"error ({self.error}) or more", fix=fix)


@dataclass(frozen=True, slots=True, kw_only=True)
class CloudReport:
    """The obstacles of one frame in the world, for `SceneFusion.update(source, "world", stamp, report.shapes)`.

    `problem` states why a frame was refused, with cause and remedy; it then has no shapes and must not be passed on.
    `clearance` [m] is the least distance between occupied voxels and robot, `lost` [m] the share of it that the boxes
    take at most, `seconds` [s] the time of this report.
    """

    shapes: tuple[PerceivedShape, ...] = ()
    problem: str = ""
    n_points: int = 0
    n_voxels: int = 0
    clearance: float = inf
    lost: float = 0.0
    seconds: float = 0.0


@dataclass(frozen=True, slots=True)
class _OwnBody:
    """Collision spheres of the robot at the time of a frame."""

    centres: Array
    radii: Array


@dataclass(slots=True)
class _Sensor:
    """One sensor: the stamp [s] of its last accepted frame, its people, and the detector of repeated frames."""

    name: str
    last_stamp: float = -inf
    people: Array = field(default_factory=lambda: np.zeros((0, 3)))
    """Centres (n, 3) [m] of the voxels with people in the last accepted frame."""
    frozen: FrozenSensorDetector = field(default_factory=FrozenSensorDetector)


class PointCloudSource:
    """Obstacles from the depth images or point clouds of one or several sensors of a cell."""

    def __init__(
        self,
        name: str,
        safety: SafetyFilter,
        config: PointCloudConfig,
        known: Sequence[Obstacle] = (),
        *,
        sensors: Sequence[str] = (),
    ) -> None:
        """Observe for the robot of `safety`. Points at `known` obstacles, such as the table, are left to these.

        `sensors` are the names of all sensors: every report has a problem until each of them has delivered a frame. By
        default a sensor counts from its first frame on. Raises `GeometryError` for a grid that is empty or too large.
        """
        self._name, self._safety, self._config, self._known = name, safety, config, tuple(known)
        self._grid = OccupancyGrid(config.lower, config.upper, config.voxel, config.memory)
        self._declared = tuple(validation.check_name("sensor", sensor) for sensor in sensors)
        self._has_begun = False
        self._near_known = self._at_known(self._grid.centres, self._grid.half_diagonal + config.error)
        self.reset()

    def reset(self) -> None:
        """Forget the stamps of all frames, for example after a jump of the clock; occupied voxels stay occupied."""
        self._sensors = {name: _Sensor(name) for name in self._declared}
        self._grid.forget_times()

    def scene_source(self, max_age: float, *, required: bool = True) -> SceneSource:
        """The entry of this source in `SceneFusion`; `max_age` [s] as there. The errors are those of the shapes.

        Of several sensors, a frame may be older than that of another one: the order is checked for each sensor here.
        """
        return SceneSource(error=0.0, max_age=max_age, required=required, max_repeats=None, in_order=False)

    def observe_depth(
        self,
        depth: ArrayLike,
        camera: PinholeCamera,
        pose: Pose,
        stamp: float,
        q: ArrayLike,
        *,
        opening: float | None = None,
        people: ArrayLike | None = None,
        sensor: str = ONLY_SENSOR,
    ) -> CloudReport:
        """Add a depth image (height, width) [m] taken at `stamp` [s] with the optical frame at `pose` in the world.

        `q` (n,) [rad] and `opening` [m] are those of the robot at this time. `people` (height, width) marks the pixels
        of people, and `sensor` is the name of the camera if there are several. Raises `GeometryError` for an image of
        another size, and for a pose or q that is not usable, and `UnknownNameError` for a sensor that is not declared.
        """
        begin, device = perf_counter(), self._sensor(sensor)
        size = (camera.height, camera.width)
        image = validation.as_real_array("depth image [m]", depth, size)
        marked = _as_mask("mask of people", people, size)
        body, turn, origin = self._body(q, opening), *_frame(pose)
        valid = camera.valid_pixels(image)
        if problem := _order_problem(device, stamp) or self._image_problem(device, image, valid, stamp):
            return CloudReport(problem=problem, seconds=perf_counter() - begin)
        self._begin_frame(device, body, stamp)
        points = camera.back_project(image, valid) @ turn.T + origin
        known = self._at_known(points, self._config.error)
        self._see_through_image(image, valid, known, camera, turn, origin, stamp)
        return self._report(device, points, known, marked[valid], body, stamp, begin)

    def observe_points(
        self,
        points: ArrayLike,
        origin: Vector,
        stamp: float,
        q: ArrayLike,
        *,
        opening: float | None = None,
        people: ArrayLike | None = None,
        sensor: str = ONLY_SENSOR,
    ) -> CloudReport:
        """Add points (n, 3) [m] in the world, measured at `stamp` [s] by a sensor at `origin` [m].

        Points that are not finite are left out; the others as for `observe_depth`.
        """
        begin, device = perf_counter(), self._sensor(sensor)
        cloud = validation.as_real_array("points [m]", points, (-1, 3))
        if len(cloud) > MAX_POINTS:
            raise GeometryError("points", got=len(cloud), allowed=f"at most {MAX_POINTS}")
        marked = _as_mask("mask of people", people, (len(cloud),))
        start = np.array(validation.check_vector("origin [m]", origin))
        body, finite = self._body(q, opening), np.isfinite(cloud).all(axis=1)
        if not finite.any():
            problem = "The cloud has no finite point. Is the sensor covered, or out of its range?"
            return CloudReport(problem=problem, seconds=perf_counter() - begin)
        if problem := _order_problem(device, stamp) or self._frozen_problem(device, cloud, stamp):
            return CloudReport(problem=problem, seconds=perf_counter() - begin)
        self._begin_frame(device, body, stamp)
        cloud, marked = cloud[finite], marked[finite]
        known = self._at_known(cloud, self._config.error)
        self._see_through_rays(start, cloud, known, stamp)
        return self._report(device, cloud, known, marked, body, stamp, begin)

    # --- one frame ----------------------------------------------------------------------------------------------

    def _body(self, q: ArrayLike, opening: float | None) -> _OwnBody:
        centres, radii, _ = self._safety.spheres(q, opening)
        if not np.isfinite(centres).all():
            raise GeometryError("configuration q", got=q, allowed="finite numbers")
        return _OwnBody(centres, radii)

    def _sensor(self, name: str) -> _Sensor:
        if self._declared and name not in self._declared:
            raise UnknownNameError("sensor", validation.check_name("sensor", name), self._declared)
        return self._sensors.setdefault(name, _Sensor(validation.check_name("sensor", name)))

    def _begin_frame(self, device: _Sensor, body: _OwnBody, stamp: float) -> None:
        """Free space of the first frame, and forgotten space of every one."""
        if not self._has_begun:
            near = self._grid.within_spheres(body.centres, body.radii + self._config.free_at_start)
            self._grid.mark_free(near, stamp)
        self._has_begun, device.last_stamp = True, stamp
        self._grid.forget(max(one.last_stamp for one in self._sensors.values()))

    def _silence_problem(self) -> str:
        """Which sensor has delivered no frame for too long, or ""."""
        newest = max(one.last_stamp for one in self._sensors.values())
        for one in self._sensors.values():
            lag = newest - one.last_stamp
            if lag > self._config.max_lag:
                text = "has delivered no frame" if lag == inf else f"is {lag:.2f} s behind the others"
                return f"The sensor {one.name!r} {text}: check its driver and its cable."
        return ""

    def _image_problem(self, device: _Sensor, image: Array, valid: Mask, stamp: float) -> str:
        """Why an image is refused, or ""."""
        if (share := float(valid.mean())) < self._config.min_valid_share:
            least = f"at least {100 * self._config.min_valid_share:.0f} % are needed"
            remedy = "Is the camera covered or too close, or are the depths not in metres?"
            return f"Only {100 * share:.0f} % of the pixels hold a depth; {least}. {remedy}"
        return self._frozen_problem(device, image, stamp)

    def _frozen_problem(self, device: _Sensor, values: Array, stamp: float) -> str:
        digest = hashlib.blake2b(values.tobytes(), digest_size=16).hexdigest()
        repeats = device.frozen.update([SensorReading(device.name, stamp, digest, noise_free=False)])
        if repeats < self._config.max_repeats:
            return ""
        return (
            f"{repeats} frames of the sensor {device.name!r} in a row are equal bit for bit: it is frozen. "
            "Start its driver again."
        )

    def _see_through_image(
        self, image: Array, valid: Mask, known: Mask, camera: PinholeCamera, turn: Array, origin: Array, stamp: float
    ) -> None:
        """Voxels that lie completely before the surface in their pixel are free.

        So are voxels at a known obstacle if the pixel of their centre shows this obstacle behind or in them.
        """
        local = (self._grid.centres - origin) @ turn
        rows, columns, inside = camera.project(local)
        seen, size = inside & valid[rows, columns], self._grid.half_diagonal + self._config.error
        shows_known = np.zeros(image.shape, bool)
        shows_known[valid] = known
        surface = image[rows, columns]
        cleared = self._near_known & shows_known[rows, columns] & (local[:, 2] - size <= surface)
        self._grid.mark_free(seen & ((local[:, 2] + size < surface) | cleared), stamp)

    def _see_through_rays(self, origin: Array, points: Array, known: Mask, stamp: float) -> None:
        """Voxels on the rays to `points` (n, 3) [m] are free, those to `known` obstacles up to the obstacle."""
        ways = points - origin
        lengths = np.maximum(np.linalg.norm(ways, axis=1), 1e-9)[:, None]
        farther = np.where(known[:, None], 2.0 * self._grid.half_diagonal / lengths, 0.0)
        self._grid.see_through_rays(origin, points + farther * ways, stamp)
        before = (points - self._config.error / lengths * ways)[known]
        self._grid.mark_free(np.unique(self._grid.index(before[self._grid.contains(before)])), stamp)

    def _report(
        self,
        device: _Sensor,
        points: Array,
        known: Mask,
        people: Mask,
        body: _OwnBody,
        stamp: float,
        begin: float,
    ) -> CloudReport:
        """Occupied voxels and people of all sensors as boxes; `begin` is the time at which the processing began.

        Points at `known` obstacles mark no voxel.
        """
        inside = self._grid.contains(points)
        points, known, people = points[inside], known[inside], people[inside]
        foreign = ~self._on_robot(points, body)
        points, known, people = points[foreign], known[foreign], people[foreign]
        self._grid.mark_free(self._grid.within_spheres(body.centres, body.radii), stamp)
        self._grid.mark_occupied(points[~people & ~known], self._config.min_points, stamp=stamp)
        device.people = (np.unique(np.floor(points[people] / self._config.voxel), axis=0) + 0.5) * self._config.voxel
        if problem := self._silence_problem():
            return CloudReport(problem=problem, seconds=perf_counter() - begin)
        centres = np.concatenate([self._grid.occupied(), self._unknown()])
        cover = cover_voxels(centres, self._config.voxel, body.centres, body.radii, limit=self._config.max_boxes)
        persons, age = self._cover_people(body, stamp)
        return CloudReport(
            shapes=(
                *self._shapes("box", cover, self._config.speed),
                *self._shapes("person", persons, self._config.person_speed, age, person=True),
            ),
            n_points=len(points),
            n_voxels=len(centres),
            clearance=min(cover.clearance, persons.clearance),
            lost=max(cover.lost, persons.lost),
            seconds=perf_counter() - begin,
        )

    def _on_robot(self, points: Array, body: _OwnBody) -> Mask:
        """Which of `points` (n, 3) [m] in the box are within the margin of the robot's spheres."""
        reach = body.radii + self._config.self_margin
        near = np.zeros(len(self._grid.centres), bool)
        near[self._grid.within_spheres(body.centres, reach + self._grid.half_diagonal)] = True
        on_robot = near[self._grid.index(points)]
        tested = points[on_robot]
        gaps = np.linalg.norm(tested[:, None] - body.centres[None], axis=-1) - reach[None]
        on_robot[on_robot] = gaps.min(axis=1, initial=inf) <= 0.0
        return on_robot

    def _unknown(self) -> Array:
        """Centres (n, 3) [m] of the unknown voxels that count as occupied: those that are at no known obstacle."""
        if not self._config.unknown_is_occupied:
            return np.zeros((0, 3))
        centres = self._grid.unknown_frontier()
        return centres[~self._near_known[self._grid.index(centres)]]

    def _at_known(self, points: Array, distance: float) -> Mask:
        """Which of `points` (n, 3) [m] are within `distance` [m] of a known obstacle."""
        found = np.zeros(len(points), bool)
        for one in self._known:
            found |= signed_distance(one.shape, one.pose, points) <= distance
        return found

    def _cover_people(self, body: _OwnBody, stamp: float) -> tuple[BoxCover, float]:
        """Boxes of the people in the last frame of every sensor, and the largest age of these frames at `stamp` [s].

        People move, so nothing of earlier frames is kept.
        """
        seen = [one for one in self._sensors.values() if len(one.people)]
        centres = np.concatenate([np.zeros((0, 3)), *(one.people for one in seen)])
        limit, voxel = self._config.max_person_boxes, self._config.voxel
        cover = cover_voxels(centres, voxel, body.centres, body.radii, limit=limit)
        return cover, max((stamp - one.last_stamp for one in seen), default=0.0)

    def _shapes(
        self, kind: str, cover: BoxCover, speed: float, age: float = 0.0, *, person: bool = False
    ) -> list[PerceivedShape]:
        """The boxes of `cover` as shapes; things in them move at most at `speed` [m/s] since `age` [s]."""
        return [
            PerceivedShape(
                name=f"{kind} {k}",
                shape=Box(_vector(0.5 * (high - low))),
                pose=Pose(_vector(0.5 * (low + high))),
                error=self._config.error + self._config.self_margin + speed * max(0.0, age),
                velocity_error=speed,
                person=person,
            )
            for k, (low, high) in enumerate(zip(cover.low, cover.high, strict=True), 1)
        ]


def _order_problem(device: _Sensor, stamp: float) -> str:
    """Why a frame is older than the last one of its sensor, or ""."""
    if validation.check_stamp("stamp of the frame [s]", stamp) >= device.last_stamp:
        return ""
    return (
        f"The stamp {stamp} s of the sensor {device.name!r} is before its last one, {device.last_stamp} s: frames are "
        "out of order. Pass frames in the order of their stamps, and call `reset` after a jump of the clock."
    )


def _frame(pose: Pose) -> tuple[Array, Array]:
    """Rotation (3, 3) and position (3,) [m] of a sensor."""
    usable = validation.check_pose("pose of the sensor", pose)
    return quaternion_to_matrix(usable.quaternion), np.array(usable.position)


def _as_mask(name: str, mask: ArrayLike | None, size: tuple[int, ...]) -> Mask:
    """`mask` as truth values of this size; all False for None."""
    if mask is None:
        return np.zeros(size, bool)
    given = np.asarray(mask)
    if given.dtype != np.bool_ or given.shape != size:
        raise GeometryError(name, got=f"{given.dtype} {given.shape}", allowed=f"truth values {size}")
    return given


def _vector(values: Array) -> Vector:
    x, y, z = (float(value) for value in values)
    return (x, y, z)
