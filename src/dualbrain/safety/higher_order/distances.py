"""Distances of points to solids, with normals and curvature: ḋ = n'w, d̈ = n'ẇ + κ for a point with velocity w.

κ = (|Q w|² − (n'w)²)/d, where Q projects onto the directions in which the nearest point of the solid does not move: all
directions for a sphere or a corner, those across the axis for the side of a capsule or an edge, only n for a face or a
plane (κ = 0). The distance to a convex solid is a convex function of the point, so κ ≥ 0.
"""

from __future__ import annotations

from collections.abc import Sequence

import msgspec
import numpy as np
from numpy.typing import NDArray

from dualbrain.core.geometry.distance import Solid
from dualbrain.core.geometry.rotations import quaternion_to_matrix
from dualbrain.core.geometry.shapes import Box, Capsule, HalfSpace, Sphere
from dualbrain.safety.cbf.obstacles import Obstacle

Array = NDArray[np.float64]
MIN_DISTANCE = 1e-9
"""Distance to an axis [m] below which any direction across the axis is used as the normal."""


class Distances(msgspec.Struct, frozen=True, eq=False, kw_only=True):
    """Distances `d` (m, k) [m] from m solids to k points, normals `n` (m, k, 3) and curvature `kappa` (m, k) [m/s²].

    `core_radius` (m,) [m] is the radius around the axis or centre to which d is measured. `curvature_radius` (m, k) is
    the distance in the denominator of κ and ṅ (infinite if normals cannot turn). `feature_stable` (m, k): the nearest
    feature cannot change while the point moves by `reach`.
    """

    d: Array
    n: Array
    kappa: Array
    core_radius: Array
    curvature_radius: Array
    feature_stable: NDArray[np.bool_]


class Segments:
    """Spheres and capsules: all points within a radius of a segment."""

    def __init__(self, obstacles: Sequence[Obstacle]) -> None:
        """Read centres, axes, half lengths and radii."""
        axes: list[Array] = []
        halves: list[float] = []
        radii: list[float] = []
        for obstacle in obstacles:
            axes.append(quaternion_to_matrix(obstacle.pose.quaternion)[:, 2])
            halves.append(obstacle.shape.half_length if isinstance(obstacle.shape, Capsule) else 0.0)
            radii.append(obstacle.shape.radius if isinstance(obstacle.shape, (Sphere, Capsule)) else 0.0)
        self._axis, self._half, self._radius = np.array(axes)[:, None], np.array(halves)[:, None], np.array(radii)

    def measure(self, points: Array, w: Array, reach: Array) -> Distances:
        """Distances of `points` (m, k, 3), relative to the centres, with velocities `w` (m, k, 3)."""
        along = np.sum(points * self._axis, axis=-1)
        offset = points - np.clip(along, -self._half, self._half)[..., None] * self._axis
        d = np.sqrt(np.sum(offset**2, axis=-1))
        n = np.where(
            d[..., None] > MIN_DISTANCE, offset / np.maximum(d, MIN_DISTANCE)[..., None], _perpendicular(self._axis)
        )
        d, side = np.maximum(d, MIN_DISTANCE), np.abs(along) < self._half
        moving = np.sum(w * w, axis=-1) - side * np.sum(w * self._axis, axis=-1) ** 2
        kappa = np.maximum(moving - np.sum(w * n, axis=-1) ** 2, 0.0) / d
        stable = (self._half == 0.0) | (np.abs(np.abs(along) - self._half) > reach)
        return Distances(d=d, n=n, kappa=kappa, core_radius=self._radius, curvature_radius=d, feature_stable=stable)


class Boxes:
    """Solid boxes; inside a box d is the negative distance to the nearest face."""

    def __init__(self, obstacles: Sequence[Obstacle]) -> None:
        """Read rotations and half extents."""
        self._rotation = np.array([quaternion_to_matrix(obstacle.pose.quaternion) for obstacle in obstacles])
        self._half = np.array(
            [obstacle.shape.half_extents for obstacle in obstacles if isinstance(obstacle.shape, Box)]
        )[:, None]

    def measure(self, points: Array, w: Array, reach: Array) -> Distances:
        """Distances of `points` (m, k, 3), relative to the centres, with velocities `w` (m, k, 3)."""
        local, local_w = points @ self._rotation, w @ self._rotation
        beyond = np.abs(local) - self._half
        deepest: Array = np.max(beyond, axis=-1)
        out, inside = np.maximum(beyond, 0.0), deepest <= 0.0
        nearest = beyond == deepest[..., None]
        offset = np.where(inside[..., None], nearest, out) * np.where(local < 0.0, -1.0, 1.0)
        size = np.sqrt(np.sum(offset**2, axis=-1))
        d = np.where(inside, deepest, size)
        n = offset / np.maximum(size, MIN_DISTANCE)[..., None]
        moving = np.sum((out > 0.0) * local_w**2, axis=-1)
        curvature_radius = np.maximum(d, MIN_DISTANCE)
        kappa = np.where(inside, 0.0, np.maximum(moving - np.sum(n * local_w, axis=-1) ** 2, 0.0) / curvature_radius)
        stable = np.all(np.abs(beyond) > reach[..., None], axis=-1)
        return Distances(
            d=d,
            n=n @ self._rotation.transpose(0, 2, 1),
            kappa=kappa,
            core_radius=np.zeros(len(self._half)),
            curvature_radius=curvature_radius,
            feature_stable=stable,
        )


class Planes:
    """Half-spaces: everything below the plane through the pose."""

    def __init__(self, obstacles: Sequence[Obstacle]) -> None:
        """Read the normals."""
        self._normal = np.array([quaternion_to_matrix(obstacle.pose.quaternion)[:, 2] for obstacle in obstacles])[
            :, None
        ]

    def measure(self, points: Array, w: Array, reach: Array) -> Distances:
        """Distances of `points` (m, k, 3), relative to a point of each plane; the curvature is zero."""
        d: Array = np.sum(points * self._normal, axis=-1)
        n = np.broadcast_to(self._normal, points.shape)
        none = np.zeros_like(d)
        return Distances(
            d=d,
            n=n,
            kappa=none,
            core_radius=np.zeros(len(d)),
            curvature_radius=none + np.inf,
            feature_stable=np.ones(d.shape, bool),
        )


SOLID_BATCHES = (Segments, Boxes, Planes)


class Solids:
    """All obstacles, one batch for each kind of solid; `order` holds their indices in the table."""

    def __init__(self, obstacles: Sequence[Obstacle]) -> None:
        """Sort the obstacles by kind."""
        indices = [
            (make, [i for i, o in enumerate(obstacles) if _batch_type(o.shape) is make]) for make in SOLID_BATCHES
        ]
        self._batches = [(make([obstacles[i] for i in at]), len(at)) for make, at in indices if at]
        self.order = [i for _, at in indices for i in at]

    def measure(self, points: Array, w: Array, reach: Array) -> Distances:
        """Distances of `points` with velocities `w`, (m, k, 3) in the order `order`, relative to the obstacles."""
        parts: list[Distances] = []
        first = 0
        for batch, count in self._batches:
            at = slice(first, first + count)
            parts.append(batch.measure(points[at], w[at], reach[at]))
            first += count
        if len(parts) == 1:
            return parts[0]
        floats = ("d", "n", "kappa", "core_radius", "curvature_radius")
        d, n, kappa, core, curvature_radius = (
            np.concatenate([_field(part, name) for part in parts]) for name in floats
        )
        return Distances(
            d=d,
            n=n,
            kappa=kappa,
            core_radius=core,
            curvature_radius=curvature_radius,
            feature_stable=np.concatenate([part.feature_stable for part in parts]),
        )


def _batch_type(shape: Solid) -> type[Segments | Boxes | Planes]:
    """The type of batch for a solid."""
    match shape:
        case Sphere() | Capsule():
            return Segments
        case Box():
            return Boxes
        case HalfSpace():
            return Planes


def _field(distances: Distances, name: str) -> Array:
    return getattr(distances, name)


def _perpendicular(axes: Array) -> Array:
    """A unit vector perpendicular to each axis (..., 3)."""
    least = np.eye(3)[np.argmin(np.abs(axes), axis=-1)]
    across = least - np.sum(least * axes, axis=-1, keepdims=True) * axes
    return across / np.linalg.norm(across, axis=-1, keepdims=True)
