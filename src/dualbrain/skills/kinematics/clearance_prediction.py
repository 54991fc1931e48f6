"""Clearance prediction: how close the arm would come to perceived objects on a path that it has not taken yet.

The prediction ranks alternatives and guarantees nothing: the filter keeps its margins independently. People are
excluded, because `human_prediction` predicts where they will be.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dualbrain.core.geometry.distance import Solid, bounding_solid, signed_distance
from dualbrain.core.geometry.rotations import rotation_error
from dualbrain.core.geometry.shapes import Box, Capsule, HalfSpace, Pose, Sphere
from dualbrain.records import Scene, SceneObject
from dualbrain.robots.model import RobotModel
from dualbrain.skills.kinematics.inverse_kinematics import DAMPING, norm
from dualbrain.skills.skill import MotionModel, PermittedContact
from dualbrain.skills.time_slicing import SlicedComputation

Array = NDArray[np.float64]

KNOWN_OBJECT_ALLOWANCE = 0.008
"""The projection φ keeps away from known objects itself; they may be this much closer [m]."""
IGNORED_START_STEPS = 3
"""Steps at the start of a path in which objects that are already close do not count."""
STEP_LENGTH = 0.016
"""Step length of a simulated path [m]; a rotation of the tool counts as 10 cm per rad."""
ROTATION_LEVER, MAX_POSTURE_DRIFT = 0.1, 0.25
"""Lever [m] of rotations, and largest posture drift per step [rad per 10 cm]."""
MAX_STEPS_PER_WAYPOINT = 120
"""Most steps to one waypoint."""
POSTURES_PER_BATCH = 6
"""Number of postures whose distances are computed at a time."""


@dataclass(frozen=True, slots=True)
class ToolGoal:
    """A tool pose to reach: position (3,) [m], rotation (3, 3), and a joint posture (n,) [rad] that reaches it."""

    position: Array
    rotation: Array
    posture: Array


@dataclass(frozen=True, slots=True, kw_only=True)
class PredictionContext:
    """Context of a prediction: the opening of each finger [m] (None: unknown), the scene, and the held object.

    Objects `known` to φ may be closer by `KNOWN_OBJECT_ALLOWANCE`. Robot parts in `contacts` may touch the obstacle.
    """

    opening: float | None
    scene: Scene
    held: str | None = None
    known: Collection[str] = ()
    contacts: Collection[PermittedContact] = ()

    def matches(self, other: PredictionContext) -> bool:
        """Whether `other` has the same scene object and equal settings."""
        return self.scene is other.scene and self._settings() == other._settings()

    def _settings(self) -> tuple[object, ...]:
        return self.opening, self.held, tuple(self.known), tuple(self.contacts)


@dataclass(frozen=True, slots=True, kw_only=True)
class CollisionObject:
    """An object to keep away from: a shape within `bounding_radius` [m] of its pose, for spheres `sphere_indices`.

    `allowance` [m] is subtracted from their distances; `max_allowance` [m] is its largest value.
    """

    shape: Solid
    pose: Pose
    bounding_radius: float
    sphere_indices: NDArray[np.intp]
    allowance: Array
    max_allowance: float


class ClearancePredictor:
    """Simulates motions of one arm and predicts their clearance."""

    def __init__(self, robot_model: RobotModel, motion: MotionModel) -> None:
        """Use the limits of `robot_model` and the kinematics of `motion`."""
        self._motion = motion
        self._redundant = robot_model.n > 6
        self._lower = np.array([joint.lower.value for joint in robot_model.joints])
        self._upper = np.array([joint.upper.value for joint in robot_model.joints])
        frames = [
            link.frame for link in robot_model.links for sphere in robot_model.spheres if sphere.link == link.name
        ]
        self._on_fixed_frame = np.array(frames) == 0
        self._cached_objects: tuple[PredictionContext, list[CollisionObject]] | None = None

    def min_clearance(
        self,
        q: Array,
        waypoints: Sequence[ToolGoal],
        context: PredictionContext,
        *,
        ignored_steps: int = 0,
        threshold: float = -np.inf,
    ) -> SlicedComputation[float]:
        """Least distance [m] of the robot to perceived objects, minus errors, from `q` through `waypoints`.

        The first `ignored_steps` postures do not count if there are more. The computation stops once the result is at
        most `threshold`.
        """
        objects = yield from self._collision_objects(q, context)
        least, batch = np.inf, list[Array]()
        for index, posture in enumerate(self.simulate_path(q, waypoints)):
            if index <= ignored_steps:
                batch.clear()
            batch.append(self._motion.spheres(posture, context.opening)[0])
            yield
            if len(batch) == POSTURES_PER_BATCH:
                least = yield from _min_clearance(np.array(batch), objects, least)
                batch.clear()
                if least <= threshold:
                    return least
        return (yield from _min_clearance(np.array(batch), objects, least)) if batch else least

    def simulate_path(self, q: Array, waypoints: Sequence[ToolGoal]) -> Iterator[Array]:
        """Postures (n,) [rad] on the path from `q` through `waypoints`, about one step apart, including the start.

        The steps are resolved-rate steps like those of φ.
        """
        yield q
        for point in waypoints:
            for _ in range(MAX_STEPS_PER_WAYPOINT):
                following = self._step_toward(q, point)
                if following is None:
                    break
                q = following
                yield q

    def _step_toward(self, q: Array, goal: ToolGoal) -> Array | None:
        """The next posture (n,) [rad] from `q` to `goal`, or None if it is reached."""
        tool = self._motion.tool(q)
        twist = np.empty(6)
        twist[:3], twist[3:] = goal.position - tool.position, rotation_error(tool.rotation, goal.rotation)
        remaining = norm(twist[:3]) + ROTATION_LEVER * norm(twist[3:])
        if remaining < 0.25 * STEP_LENGTH:
            return None
        share = min(1.0, STEP_LENGTH / remaining)
        pull = goal.posture - q if self._redundant else np.zeros_like(q)
        pull *= min(1.0, MAX_POSTURE_DRIFT * share * remaining / ROTATION_LEVER / (norm(pull) + 1e-9))
        q = q + self._motion.damped_least_squares(tool.jacobian, DAMPING, share * twist, pull)
        return np.minimum(np.maximum(q, self._lower), self._upper)

    def _collision_objects(self, q: Array, context: PredictionContext) -> SlicedComputation[list[CollisionObject]]:
        """The objects of a prediction, built once per context."""
        if self._cached_objects is None or not context.matches(self._cached_objects[0]):
            self._cached_objects = context, (yield from self._build_collision_objects(q, context))
        return self._cached_objects[1]

    def _build_collision_objects(
        self, q: Array, context: PredictionContext
    ) -> SlicedComputation[list[CollisionObject]]:
        _, radii, groups = self._motion.spheres(q, context.opening)
        held_error = next((obj.error for obj in context.scene.objects if obj.name == context.held), 0.0)
        inflated = radii + np.array([held_error if group == "held" else 0.0 for group in groups])
        fixed = np.zeros(len(groups), bool)
        fixed[: len(self._on_fixed_frame)] = self._on_fixed_frame
        objects: list[CollisionObject] = []
        for obj in context.scene.objects:
            if obj.role != "person" and obj.name != context.held:
                yield
                indices = np.flatnonzero(~fixed & ~_may_touch(obj, groups, context.contacts))
                known = KNOWN_OBJECT_ALLOWANCE if obj.name in context.known else 0.0
                allowance = (inflated + obj.error - known)[indices]
                shape, pose = bounding_solid(obj.shape, obj.pose)
                objects.append(
                    CollisionObject(
                        shape=shape,
                        pose=pose,
                        bounding_radius=_bounding_radius(shape),
                        sphere_indices=indices,
                        allowance=allowance,
                        max_allowance=float(allowance.max(initial=0.0)),
                    )
                )
        return objects


def _min_clearance(centres: Array, objects: Sequence[CollisionObject], least: float) -> SlicedComputation[float]:
    """The minimum of `least` [m] and the clearance of spheres at `centres` (postures, spheres, 3)."""
    spans = [(float(column.min()), float(column.max())) for column in np.moveaxis(centres, -1, 0)]
    yield
    for obj in objects:
        if _distance_to_box(obj.pose, spans) - obj.bounding_radius - obj.max_allowance < least:
            distance = signed_distance(obj.shape, obj.pose, centres.take(obj.sphere_indices, axis=1)) - obj.allowance
            least = min(least, float(distance.min(initial=np.inf)))
            yield
    return least


def _may_touch(obj: SceneObject, groups: Sequence[str], contacts: Collection[PermittedContact]) -> NDArray[np.bool_]:
    """Mask of the spheres that may touch `obj`."""
    parts = {contact.robot_part for contact in contacts if contact.obstacle == obj.name}
    return np.array([group in parts for group in groups])


def _distance_to_box(pose: Pose, spans: Sequence[tuple[float, float]]) -> float:
    """Distance [m] between the position of `pose` and an axis-aligned box, given by its span along each axis."""
    beyond = (max(low - x, 0.0, x - high) for x, (low, high) in zip(pose.position, spans, strict=True))
    return sum(distance * distance for distance in beyond) ** 0.5


def _bounding_radius(shape: Solid) -> float:
    """Radius [m] of the smallest sphere around the centre of a solid that contains it."""
    match shape:
        case Sphere(radius):
            return radius
        case Capsule(radius, half_length):
            return radius + half_length
        case Box(half_extents):
            return sum(half * half for half in half_extents) ** 0.5
        case HalfSpace():
            return float("inf")
