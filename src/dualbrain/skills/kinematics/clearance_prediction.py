"""Foresight: how near the arm would come to what is perceived on a way it has not gone yet.

It chooses between ways of doing the same thing and promises nothing: the filter keeps its margins whatever was
foreseen. People are left out, because where they will be is `person`'s business.
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
from dualbrain.skills.kinematics.inverse_kinematics import damped_step, norm
from dualbrain.skills.skill import MotionModel, PermittedContact
from dualbrain.skills.time_slicing import SlicedComputation

Array = NDArray[np.float64]

KNOWN_OBJECT_ALLOWANCE = 0.008
"""φ itself keeps off what it knows, and passes it this much nearer without being bent [m]."""
IGNORED_START_STEPS = 3
"""Strides at the start of a way on which what is near already does not count."""
STEP_LENGTH = 0.016
"""Step of a rehearsal [m]; a turn of the tool counts as 10 cm per rad."""
ROTATION_LEVER, MAX_POSTURE_DRIFT = 0.1, 0.25
"""Lever [m] by which turns are counted, and how far the posture is pulled in a step at most [rad per 10 cm]."""
MAX_STEPS_PER_WAYPOINT = 120
"""Strides to one point, at most."""
POSTURES_PER_BATCH = 6
"""Postures that are held against a thing at a time."""


@dataclass(frozen=True, slots=True)
class ToolGoal:
    """A tool pose to reach: position (3,) [m], rotation (3, 3), and the joint posture (n,) [rad] that suits it."""

    position: Array
    rotation: Array
    posture: Array


@dataclass(frozen=True, slots=True, kw_only=True)
class PredictionContext:
    """What a rehearsal goes by: how far each finger is opened [m], what is perceived, which thing is held.

    What is `known` to φ may be `NEARER`, and does not count for a part that may touch it (`touches`).
    """

    opening: float
    scene: Scene
    held: str | None = None
    known: Collection[str] = ()
    contacts: Collection[PermittedContact] = ()

    def matches(self, other: PredictionContext) -> bool:
        """Whether the other is a view of this very scene, otherwise alike."""
        return self.scene is other.scene and self._settings() == other._settings()

    def _settings(self) -> tuple[object, ...]:
        return self.opening, self.held, tuple(self.known), tuple(self.contacts)


@dataclass(frozen=True, slots=True, kw_only=True)
class CollisionObject:
    """A thing to keep clear of: its cover, all of it within `reach` [m] of its middle, for the spheres that `count`.

    `allowance` [m] is taken off their distances, `most` [m] at most.
    """

    shape: Solid
    pose: Pose
    bounding_radius: float
    sphere_indices: NDArray[np.intp]
    allowance: Array
    max_allowance: float


class ClearancePredictor:
    """Rehearses motions of one arm in its head."""

    def __init__(self, robot_model: RobotModel, motion: MotionModel) -> None:
        """Bind to the body and to the local layer's kinematics."""
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
        """Least distance [m] between the body and what is perceived, beyond the errors, from `q` through `points`.

        The first `leaving` postures do not count, as long as any is left. Broken off once it is not above `beat`.
        """
        hindrances = yield from self._collision_objects(q, context)
        least, shown = np.inf, list[Array]()
        for index, posture in enumerate(self.simulate_path(q, waypoints)):
            if index <= ignored_steps:
                shown.clear()
            shown.append(self._motion.spheres(posture, context.opening)[0])
            yield
            if len(shown) == POSTURES_PER_BATCH:
                least = yield from _min_clearance(np.array(shown), hindrances, least)
                shown.clear()
                if least <= threshold:
                    return least
        return (yield from _min_clearance(np.array(shown), hindrances, least)) if shown else least

    def simulate_path(self, q: Array, waypoints: Sequence[ToolGoal]) -> Iterator[Array]:
        """Postures (n,) [rad] on the way from `q` through `points`, about a stride apart, the start included.

        Resolved-rate steps, as φ would take them.
        """
        yield q
        for point in waypoints:
            for _ in range(MAX_STEPS_PER_WAYPOINT):
                further = self._step_toward(q, point)
                if further is None:
                    break
                q = further
                yield q

    def _step_toward(self, q: Array, goal: ToolGoal) -> Array | None:
        """The next posture (n,) [rad] from `q` to `point`; None when it is there."""
        tool = self._motion.tool(q)
        twist = np.empty(6)
        twist[:3], twist[3:] = goal.position - tool.position, rotation_error(tool.rotation, goal.rotation)
        ahead = norm(twist[:3]) + ROTATION_LEVER * norm(twist[3:])
        if ahead < 0.25 * STEP_LENGTH:
            return None
        share = min(1.0, STEP_LENGTH / ahead)
        pull = goal.posture - q if self._redundant else np.zeros_like(q)
        pull *= min(1.0, MAX_POSTURE_DRIFT * share * ahead / ROTATION_LEVER / (norm(pull) + 1e-9))
        q = q + damped_step(tool.jacobian, share * twist, pull)
        return np.minimum(np.maximum(q, self._lower), self._upper)

    def _collision_objects(self, q: Array, context: PredictionContext) -> SlicedComputation[list[CollisionObject]]:
        """What the way is held against; made once for every view."""
        if self._cached_objects is None or not context.matches(self._cached_objects[0]):
            self._cached_objects = context, (yield from self._build_collision_objects(q, context))
        return self._cached_objects[1]

    def _build_collision_objects(
        self, q: Array, context: PredictionContext
    ) -> SlicedComputation[list[CollisionObject]]:
        _, radii, groups = self._motion.spheres(q, context.opening)
        extra = next((thing.error for thing in context.scene.objects if thing.name == context.held), 0.0)
        reach = radii + np.array([extra if group == "held" else 0.0 for group in groups])
        base = np.zeros(len(groups), bool)
        base[: len(self._on_fixed_frame)] = self._on_fixed_frame
        hindrances: list[CollisionObject] = []
        for thing in context.scene.objects:
            if thing.role != "person" and thing.name != context.held:
                yield
                count = np.flatnonzero(~base & ~_may_touch(thing, groups, context.contacts))
                allowance = (reach + thing.error - (KNOWN_OBJECT_ALLOWANCE if thing.name in context.known else 0.0))[
                    count
                ]
                shape, pose = bounding_solid(thing.shape, thing.pose)
                most = float(allowance.max(initial=0.0))
                hindrances.append(
                    CollisionObject(
                        shape=shape,
                        pose=pose,
                        bounding_radius=_bounding_radius(shape),
                        sphere_indices=count,
                        allowance=allowance,
                        max_allowance=most,
                    )
                )
        return hindrances


def _min_clearance(centres: Array, objects: Sequence[CollisionObject], least: float) -> SlicedComputation[float]:
    """`least` [m], or the least room of spheres at `centres` (postures, spheres, 3) where that is less."""
    spans = [(float(column.min()), float(column.max())) for column in np.moveaxis(centres, -1, 0)]
    yield
    for one in objects:
        if _distance_to_box(one.pose, spans) - one.bounding_radius - one.max_allowance < least:
            apart = signed_distance(one.shape, one.pose, centres.take(one.sphere_indices, axis=1)) - one.allowance
            least = min(least, float(apart.min(initial=np.inf)))
            yield
    return least


def _may_touch(obj: SceneObject, groups: Sequence[str], contacts: Collection[PermittedContact]) -> NDArray[np.bool_]:
    """Which spheres may touch `thing`."""
    parts = {touch.robot_part for touch in contacts if touch.obstacle == obj.name}
    return np.array([group in parts for group in groups])


def _distance_to_box(pose: Pose, spans: Sequence[tuple[float, float]]) -> float:
    """Distance [m] of the middle of `pose` from an upright box, given by its span along each axis."""
    beyond = (max(low - x, 0.0, x - high) for x, (low, high) in zip(pose.position, spans, strict=True))
    return sum(one * one for one in beyond) ** 0.5


def _bounding_radius(shape: Solid) -> float:
    """How far from its middle a solid goes at most [m]."""
    match shape:
        case Sphere(radius):
            return radius
        case Capsule(radius, half_length):
            return radius + half_length
        case Box(half_extents):
            return sum(half * half for half in half_extents) ** 0.5
        case HalfSpace():
            return float("inf")
