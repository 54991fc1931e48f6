"""Barriers of all pairs at one state: h, ḣ and the part of ḧ that no control changes, of obstacles and own parts."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from dualbrain.errors import InvalidSetup, UnknownName
from dualbrain.robots.model import Body
from dualbrain.safety.cbf.obstacles import Obstacle
from dualbrain.safety.cbf.rows import Rank
from dualbrain.safety.higher_order.distances import Solids
from dualbrain.safety.higher_order.sampling_margin import Course, lasting, margin
from dualbrain.safety.higher_order.sphere_kinematics import Index, Motion, Spheres, cross

Array = NDArray[np.float64]
OWN = -1


class Pairs(msgspec.Struct, frozen=True, eq=False):
    """p pairs, ḧ = n'(J_far − J_near) q̈ + ...: `h` [m], `rate` ḣ [m/s] and `rest` [m/s²], all (p,).

    `rest` is n'J̇q̇ + κ less the sampling margin, κ as far as it lasts; `authority` (p,) bounds |ḧ| [m/s²] by any
    admissible control. `far` is the sphere, `near` the sphere of the own part or OWN, `thing` the obstacle or OWN.
    """

    h: Array
    rate: Array
    rest: Array
    authority: Array
    alpha_1: Array
    normal: Array
    far: Index
    near: Index
    thing: Index
    rank: Index

    def only(self, which: NDArray[np.bool_]) -> Pairs:
        """The pairs marked in `which` (p,)."""
        return Pairs(
            self.h[which], self.rate[which], self.rest[which], self.authority[which], self.alpha_1[which],
            self.normal[which], self.far[which], self.near[which], self.thing[which], self.rank[which],
        )  # fmt: skip


def joined(first: Pairs, second: Pairs) -> Pairs:
    """All pairs of both."""

    def both(name: str) -> Any:
        return np.concatenate([getattr(first, name), getattr(second, name)])

    return Pairs(*(both(name) for name in Pairs.__struct_fields__))


class OwnPairs:
    """Pairs of spheres on links that are kept apart, the one nearer to the base as seen from which the other moves."""

    def __init__(self, body: Body, spheres: Spheres, clearance: float, alpha_1: float) -> None:
        """Lay out the pairs; spheres on one frame cannot move against each other and have none."""
        pairs = [
            sorted((i, j), key=spheres.frame)
            for one, other in body.self_pairs.kept
            for i in spheres.of(one)
            for j in spheres.of(other)
        ]
        table = np.array([p for p in pairs if spheres.frames[p[0]] < spheres.frames[p[1]]], np.int64).reshape(-1, 2)
        self._near, self._far = np.ascontiguousarray(table[:, 0]), np.ascontiguousarray(table[:, 1])
        self._start = spheres.frames[self._near]
        self._apart = spheres.radii[self._near] + spheres.radii[self._far] + clearance
        self._own = np.full(len(table), OWN, np.int64)
        self._rank = np.full(len(table), int(Rank.BODY), np.int64)
        self._alpha_1 = np.full(len(table), alpha_1)

    def at(self, motion: Motion, seen: Sequence[Course], dt: float) -> Pairs:
        """The pairs at `motion`; `seen` are the courses by frame.

        What bends is counted in the frame of the near sphere, where that sphere rests: only then do the bounds of the
        far one's course bound the pair's.
        """
        near, far = self._near, self._far
        offset, w = motion.centres[far] - motion.centres[near], motion.velocities[far] - motion.velocities[near]
        d = np.maximum(np.sqrt(np.einsum("pi,pi->p", offset, offset)), 1e-9)
        n = offset / d[:, None]
        rate = np.einsum("pi,pi->p", n, w)
        bias = np.einsum("pi,pi->p", n, motion.bias[far] - motion.bias[near])
        inside = w - cross(motion.spins[near], offset)
        kappa = (np.einsum("pi,pi->p", w, w) - rate**2) / d
        kappa_seen = np.maximum(np.einsum("pi,pi->p", inside, inside) - rate**2, 0.0) / d
        course = _picked(seen, self._start, far)
        bends = np.maximum(d - dt * course.speed, self._apart)
        kept = lasting(kappa_seen, course, course.speed, bends, dt)
        rest = bias + kappa - kappa_seen + kept - margin(course, course.speed, bends, self._alpha_1, dt)
        return Pairs(d - self._apart, rate, rest, course.authority, self._alpha_1, n, far, near, self._own, self._rank)


class ThingPairs:
    """Pairs of moving spheres and obstacles."""

    def __init__(self, body: Body, spheres: Spheres, things: Sequence[Obstacle], alpha_1: float) -> None:
        """Lay out the table; an obstacle may name the only parts of the robot that are kept from it."""
        self._solids = Solids(things)
        ordered = [things[i] for i in self._solids.order]
        self._centre = np.array([thing.pose.position for thing in ordered])[:, None]
        self._velocity = np.array([thing.velocity for thing in ordered])[:, None]
        self._margin = np.array([thing.margin for thing in ordered])[:, None]
        self._error = np.array([thing.velocity_error for thing in ordered])[:, None]
        self._radii = spheres.radii
        concerned = np.array([_concerned(thing, body, spheres) for thing in ordered])
        self._which = concerned & (spheres.frames > 0)
        shape = (len(ordered), len(spheres.names))
        alpha = [alpha_1 if thing.alpha is None else thing.alpha for thing in ordered]
        self._alpha_1 = np.broadcast_to(np.array(alpha)[:, None], shape)
        self._rank = np.broadcast_to(np.array([int(thing.rank) for thing in ordered])[:, None], shape)
        self._thing = np.broadcast_to(np.array(self._solids.order)[:, None], shape)
        self._far = np.broadcast_to(np.arange(shape[1]), shape)
        self._near = np.full(shape, OWN, np.int64)

    def at(self, motion: Motion, course: Course, age: float, dt: float) -> Pairs:
        """The pairs at `motion`, `age` [s] after the obstacles were seen: they moved on, their margins grew."""
        points = motion.centres - self._centre - age * self._velocity
        w = motion.velocities - self._velocity
        speed = np.sqrt(np.einsum("mki,mki->mk", w, w)) + dt * course.acceleration
        gaps = self._solids.measure(points, w, dt * speed)
        apart = self._radii + gaps.core[:, None] + self._margin + age * self._error
        rate = np.einsum("mki,mki->mk", gaps.n, w)
        bends = np.maximum(gaps.bends - dt * speed, np.minimum(apart, gaps.bends))
        kept = np.where(gaps.steady, lasting(gaps.kappa, course, speed, bends, dt), 0.0)
        rest = np.einsum("mki,ki->mk", gaps.n, motion.bias) + kept - margin(course, speed, bends, self._alpha_1, dt)
        authority = np.broadcast_to(course.authority, rest.shape)
        return Pairs(
            gaps.d - apart, rate - self._error, rest, authority, self._alpha_1, gaps.n, self._far, self._near,
            self._thing, self._rank,
        ).only(self._which)  # fmt: skip


def _concerned(thing: Obstacle, body: Body, spheres: Spheres) -> NDArray[np.bool_]:
    """Which spheres (k,) are kept from `thing`."""
    if thing.separation is not None:
        raise InvalidSetup(
            f"obstacle {thing.name!r}", got="speed and separation", allowed="a barrier on distance",
            fix="Speed and separation is a rule on velocities: use SafetyFilter.",
        )  # fmt: skip
    known = (*dict.fromkeys(spheres.groups), *(link.name for link in body.links))
    for part in thing.parts:
        if part not in known:
            raise UnknownName("part of the robot", part, known, owner=body.name)
    named = zip(spheres.names, spheres.groups, strict=True)
    return np.array([not thing.parts or name in thing.parts or group in thing.parts for name, group in named])


def _picked(seen: Sequence[Course], start: Index, far: Index) -> Course:
    """The bounds of each far sphere as seen from its own start frame."""
    by_frame = zip(
        *((course.speed, course.acceleration, course.jerk, course.authority) for course in seen), strict=True
    )
    return Course(*(np.array(bounds)[start, far] for bounds in by_frame))
