"""Barriers of all pairs at one state, for obstacles and self-collision: h, ḣ and the control-independent part of ḧ."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from dualbrain.errors import ConfigurationError, UnknownNameError
from dualbrain.robots.model import RobotModel
from dualbrain.safety.cbf.obstacles import Obstacle
from dualbrain.safety.cbf.rows import Rank
from dualbrain.safety.higher_order.distances import Solids
from dualbrain.safety.higher_order.sampling_margin import MotionBounds, guaranteed_curvature, sampling_margin
from dualbrain.safety.higher_order.sphere_kinematics import Index, SphereKinematics, SphereMotion, cross

Array = NDArray[np.float64]
NO_INDEX = -1


class Pairs(msgspec.Struct, frozen=True, eq=False, kw_only=True):
    """Pairs (p,) with ḧ = n'(J_sphere − J_near_sphere) q̈ + drift: `h` [m], `h_dot` ḣ [m/s] and `drift` [m/s²].

    `drift` is n'J̇q̇ + κ minus the sampling margin, with the part of κ that lasts for the period. `authority` bounds the
    effect of any admissible control on |ḧ| [m/s²]. `sphere` is the index of the sphere; `near_sphere` is the sphere of
    the other link and `obstacle` the index of the obstacle, one of them `NO_INDEX`. `normal` is (p, 3).
    """

    h: Array
    h_dot: Array
    drift: Array
    authority: Array
    alpha_1: Array
    normal: Array
    sphere: Index
    near_sphere: Index
    obstacle: Index
    rank: Index

    def select(self, which: NDArray[np.bool_]) -> Pairs:
        """The pairs marked in `which` (p,)."""
        return Pairs(
            h=self.h[which],
            h_dot=self.h_dot[which],
            drift=self.drift[which],
            authority=self.authority[which],
            alpha_1=self.alpha_1[which],
            normal=self.normal[which],
            sphere=self.sphere[which],
            near_sphere=self.near_sphere[which],
            obstacle=self.obstacle[which],
            rank=self.rank[which],
        )


def concatenate(first: Pairs, second: Pairs) -> Pairs:
    """All pairs of both arguments."""

    def both(name: str) -> Any:
        return np.concatenate([getattr(first, name), getattr(second, name)])

    return Pairs(**{name: both(name) for name in Pairs.__struct_fields__})


class SelfCollisionPairs:
    """Pairs of spheres on links that keep apart; motion is relative to the sphere nearer to the base."""

    def __init__(self, robot_model: RobotModel, spheres: SphereKinematics, clearance: float, alpha_1: float) -> None:
        """Prepare the pairs; spheres on one frame do not move relative to each other and form no pair."""
        pairs = [
            sorted((i, j), key=spheres.frame_of)
            for one, other in robot_model.self_pairs.kept
            for i in spheres.on_link(one)
            for j in spheres.on_link(other)
        ]
        table = np.array([p for p in pairs if spheres.frames[p[0]] < spheres.frames[p[1]]], np.int64).reshape(-1, 2)
        self._near_sphere, self._sphere = np.ascontiguousarray(table[:, 0]), np.ascontiguousarray(table[:, 1])
        self._start = spheres.frames[self._near_sphere]
        self._min_distance = spheres.radii[self._near_sphere] + spheres.radii[self._sphere] + clearance
        self._no_index = np.full(len(table), NO_INDEX, np.int64)
        self._rank = np.full(len(table), int(Rank.BODY), np.int64)
        self._alpha_1 = np.full(len(table), alpha_1)

    def compute(self, motion: SphereMotion, bounds_by_frame: Sequence[MotionBounds], dt: float) -> Pairs:
        """The pairs at `motion`, with motion bounds by frame over the period dt [s].

        The curvature is computed in the frame of the near sphere, in which that sphere is at rest, because only there
        the motion bounds of the far sphere are bounds of the pair.
        """
        near, far = self._near_sphere, self._sphere
        offset, w = motion.centres[far] - motion.centres[near], motion.velocities[far] - motion.velocities[near]
        d = np.maximum(np.sqrt(np.einsum("pi,pi->p", offset, offset)), 1e-9)
        n = offset / d[:, None]
        rate = np.einsum("pi,pi->p", n, w)
        bias = np.einsum("pi,pi->p", n, motion.bias[far] - motion.bias[near])
        inside = w - cross(motion.angular_velocities[near], offset)
        kappa = (np.einsum("pi,pi->p", w, w) - rate**2) / d
        kappa_seen = np.maximum(np.einsum("pi,pi->p", inside, inside) - rate**2, 0.0) / d
        seen = _select_bounds(bounds_by_frame, self._start, far)
        radius = np.maximum(d - dt * seen.speed, self._min_distance)
        kept = guaranteed_curvature(kappa_seen, seen, seen.speed, radius, dt)
        drift = bias + kappa - kappa_seen + kept - sampling_margin(seen, seen.speed, radius, self._alpha_1, dt)
        return Pairs(
            h=d - self._min_distance,
            h_dot=rate,
            drift=drift,
            authority=seen.authority,
            alpha_1=self._alpha_1,
            normal=n,
            sphere=far,
            near_sphere=near,
            obstacle=self._no_index,
            rank=self._rank,
        )


class ObstaclePairs:
    """Pairs of a moving sphere of the robot and an obstacle."""

    def __init__(
        self, robot_model: RobotModel, spheres: SphereKinematics, obstacles: Sequence[Obstacle], alpha_1: float
    ) -> None:
        """Prepare the table; `Obstacle.parts` restricts the parts of the robot that keep away."""
        self._solids = Solids(obstacles)
        ordered = [obstacles[i] for i in self._solids.order]
        self._centre = np.array([obstacle.pose.position for obstacle in ordered])[:, None]
        self._velocity = np.array([obstacle.velocity for obstacle in ordered])[:, None]
        self._margin = np.array([obstacle.margin for obstacle in ordered])[:, None]
        self._error = np.array([obstacle.velocity_error for obstacle in ordered])[:, None]
        self._radii = spheres.radii
        affected = np.array([_affected_spheres(obstacle, robot_model, spheres) for obstacle in ordered])
        self._affected = affected & (spheres.frames > 0)
        shape = (len(ordered), len(spheres.names))
        alpha = [alpha_1 if obstacle.alpha is None else obstacle.alpha for obstacle in ordered]
        self._alpha_1 = np.broadcast_to(np.array(alpha)[:, None], shape)
        self._rank = np.broadcast_to(np.array([int(obstacle.rank) for obstacle in ordered])[:, None], shape)
        self._obstacle = np.broadcast_to(np.array(self._solids.order)[:, None], shape)
        self._sphere = np.broadcast_to(np.arange(shape[1]), shape)
        self._near_sphere = np.full(shape, NO_INDEX, np.int64)

    def compute(self, motion: SphereMotion, bounds: MotionBounds, age: float, dt: float) -> Pairs:
        """The pairs at `motion`, with obstacles and margins extrapolated by `age` [s]; dt [s] is the period."""
        points = motion.centres - self._centre - age * self._velocity
        w = motion.velocities - self._velocity
        speed = np.sqrt(np.einsum("mki,mki->mk", w, w)) + dt * bounds.acceleration
        gaps = self._solids.measure(points, w, dt * speed)
        min_distance = self._radii + gaps.core_radius[:, None] + self._margin + age * self._error
        rate = np.einsum("mki,mki->mk", gaps.n, w)
        radius = np.maximum(gaps.curvature_radius - dt * speed, np.minimum(min_distance, gaps.curvature_radius))
        kept = np.where(gaps.feature_stable, guaranteed_curvature(gaps.kappa, bounds, speed, radius, dt), 0.0)
        drift = (
            np.einsum("mki,ki->mk", gaps.n, motion.bias)
            + kept
            - sampling_margin(bounds, speed, radius, self._alpha_1, dt)
        )
        authority = np.broadcast_to(bounds.authority, drift.shape)
        return Pairs(
            h=gaps.d - min_distance,
            h_dot=rate - self._error,
            drift=drift,
            authority=authority,
            alpha_1=self._alpha_1,
            normal=gaps.n,
            sphere=self._sphere,
            near_sphere=self._near_sphere,
            obstacle=self._obstacle,
            rank=self._rank,
        ).select(self._affected)


def _affected_spheres(obstacle: Obstacle, robot_model: RobotModel, spheres: SphereKinematics) -> NDArray[np.bool_]:
    """Mask (k,) of the spheres that keep away from `obstacle`."""
    if obstacle.separation is not None:
        raise ConfigurationError(
            f"obstacle {obstacle.name!r}",
            got="speed and separation",
            allowed="a barrier on distance",
            fix="Use SafetyFilter, because speed and separation is a rule on velocities.",
        )
    known = (*dict.fromkeys(spheres.groups), *(link.name for link in robot_model.links))
    for part in obstacle.parts:
        if part not in known:
            raise UnknownNameError("part of the robot", part, known, owner=robot_model.name)
    named = zip(spheres.names, spheres.groups, strict=True)
    return np.array([not obstacle.parts or name in obstacle.parts or group in obstacle.parts for name, group in named])


def _select_bounds(bounds_by_frame: Sequence[MotionBounds], start: Index, far: Index) -> MotionBounds:
    """Bounds of each far sphere relative to the frame of its near sphere."""
    by_frame = zip(
        *((seen.speed, seen.acceleration, seen.jerk, seen.authority) for seen in bounds_by_frame), strict=True
    )
    return MotionBounds(*(np.array(bounds)[start, far] for bounds in by_frame))
