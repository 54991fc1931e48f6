"""Foresight: how near the arm would come to what is perceived on a way it has not gone yet.

It chooses between ways of doing the same thing and promises nothing: the filter keeps its margins whatever was
foreseen. People are left out, because where they will be is `person`'s business.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dualbrain.core.geometry.distance import Solid, distance, solid
from dualbrain.core.geometry.rotations import rotation_error
from dualbrain.core.geometry.shapes import Box, Capsule, HalfSpace, Pose, Sphere
from dualbrain.records import Scene, SceneObject
from dualbrain.robots.model import Body
from dualbrain.skills.kinematics.inverse_kinematics import damped, length
from dualbrain.skills.skill import Motion, Touch
from dualbrain.skills.time_slicing import Thought

Array = NDArray[np.float64]

NEARER = 0.008
"""φ itself keeps off what it knows, and passes it this much nearer without being bent [m]."""
LEAVING = 3
"""Strides at the start of a way on which what is near already does not count."""
STRIDE = 0.016
"""Step of a rehearsal [m]; a turn of the tool counts as 10 cm per rad."""
LEVER, DRIFT = 0.1, 0.25
"""Lever [m] by which turns are counted, and how far the posture is pulled in a step at most [rad per 10 cm]."""
LONGEST = 120
"""Strides to one point, at most."""
TOGETHER = 6
"""Postures that are held against a thing at a time."""


@dataclass(frozen=True, slots=True)
class Goal:
    """A tool pose to reach: position (3,) [m], rotation (3, 3), and the joint posture (n,) [rad] that suits it."""

    position: Array
    rotation: Array
    posture: Array


@dataclass(frozen=True, slots=True)
class View:
    """What a rehearsal goes by: how far each finger is opened [m], what is perceived, which thing is held.

    What is `known` to φ may be `NEARER`, and does not count for a part that may touch it (`touches`).
    """

    opening: float
    scene: Scene
    held: str | None = None
    known: Collection[str] = ()
    touches: Collection[Touch] = ()

    def same(self, other: View) -> bool:
        """Whether the other is a view of this very scene, otherwise alike."""
        return self.scene is other.scene and self._rest() == other._rest()

    def _rest(self) -> tuple[object, ...]:
        return self.opening, self.held, tuple(self.known), tuple(self.touches)


@dataclass(frozen=True, slots=True)
class Hindrance:
    """A thing to keep clear of: its cover, all of it within `reach` [m] of its middle, for the spheres that `count`.

    `allowance` [m] is taken off their distances, `most` [m] at most.
    """

    shape: Solid
    pose: Pose
    reach: float
    count: NDArray[np.intp]
    allowance: Array
    most: float


class Foresight:
    """Rehearses motions of one arm in its head."""

    def __init__(self, body: Body, motion: Motion) -> None:
        """Bind to the body and to the local layer's kinematics."""
        self._motion = motion
        self._redundant = body.n > 6
        self._lower = np.array([joint.lower.value for joint in body.joints])
        self._upper = np.array([joint.upper.value for joint in body.joints])
        frames = [link.frame for link in body.links for sphere in body.spheres if sphere.link == link.name]
        self._bolted = np.array(frames) == 0
        self._met: tuple[View, list[Hindrance]] | None = None

    def room(
        self, q: Array, points: Sequence[Goal], view: View, *, leaving: int = 0, beat: float = -np.inf
    ) -> Thought[float]:  # fmt: skip
        """Least distance [m] between the body and what is perceived, beyond the errors, from `q` through `points`.

        The first `leaving` postures do not count, as long as any is left. Broken off once it is not above `beat`.
        """
        hindrances = yield from self._meet(q, view)
        least, shown = np.inf, list[Array]()
        for index, posture in enumerate(self.way(q, points)):
            if index <= leaving:
                shown.clear()
            shown.append(self._motion.spheres(posture, view.opening)[0])
            yield
            if len(shown) == TOGETHER:
                least = yield from _least(np.array(shown), hindrances, least)
                shown.clear()
                if least <= beat:
                    return least
        return (yield from _least(np.array(shown), hindrances, least)) if shown else least

    def way(self, q: Array, points: Sequence[Goal]) -> Iterator[Array]:
        """Postures (n,) [rad] on the way from `q` through `points`, about a stride apart, the start included.

        Resolved-rate steps, as φ would take them.
        """
        yield q
        for point in points:
            for _ in range(LONGEST):
                further = self._stride(q, point)
                if further is None:
                    break
                q = further
                yield q

    def _stride(self, q: Array, point: Goal) -> Array | None:
        """The next posture (n,) [rad] from `q` to `point`; None when it is there."""
        tool = self._motion.tool(q)
        twist = np.empty(6)
        twist[:3], twist[3:] = point.position - tool.position, rotation_error(tool.rotation, point.rotation)
        ahead = length(twist[:3]) + LEVER * length(twist[3:])
        if ahead < 0.25 * STRIDE:
            return None
        share = min(1.0, STRIDE / ahead)
        pull = point.posture - q if self._redundant else np.zeros_like(q)
        pull *= min(1.0, DRIFT * share * ahead / LEVER / (length(pull) + 1e-9))
        q = q + damped(tool.jacobian, share * twist, pull)
        return np.minimum(np.maximum(q, self._lower), self._upper)

    def _meet(self, q: Array, view: View) -> Thought[list[Hindrance]]:
        """What the way is held against; made once for every view."""
        if self._met is None or not view.same(self._met[0]):
            self._met = view, (yield from self._hindrances(q, view))
        return self._met[1]

    def _hindrances(self, q: Array, view: View) -> Thought[list[Hindrance]]:
        _, radii, groups = self._motion.spheres(q, view.opening)
        extra = next((thing.error for thing in view.scene.objects if thing.name == view.held), 0.0)
        reach = radii + np.array([extra if group == "held" else 0.0 for group in groups])
        base = np.zeros(len(groups), bool)
        base[: len(self._bolted)] = self._bolted
        hindrances: list[Hindrance] = []
        for thing in view.scene.objects:
            if thing.role != "person" and thing.name != view.held:
                yield
                count = np.flatnonzero(~base & ~_spared(thing, groups, view.touches))
                allowance = (reach + thing.error - (NEARER if thing.name in view.known else 0.0))[count]
                shape, pose = solid(thing.shape, thing.pose)
                most = float(allowance.max(initial=0.0))
                hindrances.append(Hindrance(shape, pose, _reach(shape), count, allowance, most))
        return hindrances


def _least(centres: Array, hindrances: Sequence[Hindrance], least: float) -> Thought[float]:
    """`least` [m], or the least room of spheres at `centres` (postures, spheres, 3) where that is less."""
    spans = [(float(column.min()), float(column.max())) for column in np.moveaxis(centres, -1, 0)]
    yield
    for one in hindrances:
        if _gap(one.pose, spans) - one.reach - one.most < least:
            apart = distance(one.shape, one.pose, centres.take(one.count, axis=1)) - one.allowance
            least = min(least, float(apart.min(initial=np.inf)))
            yield
    return least


def _spared(thing: SceneObject, groups: Sequence[str], touches: Collection[Touch]) -> NDArray[np.bool_]:
    """Which spheres may touch `thing`."""
    parts = {touch.robot_part for touch in touches if touch.obstacle == thing.name}
    return np.array([group in parts for group in groups])


def _gap(pose: Pose, spans: Sequence[tuple[float, float]]) -> float:
    """Distance [m] of the middle of `pose` from an upright box, given by its span along each axis."""
    beyond = (max(low - x, 0.0, x - high) for x, (low, high) in zip(pose.position, spans, strict=True))
    return sum(one * one for one in beyond) ** 0.5


def _reach(shape: Solid) -> float:
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
