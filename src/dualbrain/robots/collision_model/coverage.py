"""Does a set of balls cover a mesh, and how far does it bulge out? Measured on points, and proven on triangles."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dualbrain.robots.assets.meshes import Mesh
from dualbrain.robots.optional_imports import import_optional

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class SphereSet:
    """Balls of one link: `centres` (b, 3) and `radii` (b,) in metres."""

    centres: Array
    radii: Array


@dataclass(frozen=True, slots=True)
class Excess:
    """How far the surface of the union of balls stands off the mesh [m], and union volume / mesh volume."""

    mean: float
    p95: float
    worst: float
    volume_ratio: float


def are_covered(points: Array, spheres: SphereSet, tolerance: float = 0.0) -> NDArray[np.bool_]:
    """Whether each point (p, 3) lies in some ball (grown by `tolerance` [m])."""
    result = np.zeros(len(points), dtype=bool)
    for centre, radius in zip(spheres.centres, spheres.radii, strict=True):
        result |= np.sum((points - centre) ** 2, axis=1) <= (radius + tolerance) ** 2
    return result


def is_proven_covered(mesh: Mesh, spheres: SphereSet, max_subdivisions: int = 9) -> bool:
    """True if every point of every face lies in a ball: a proof, not a sample.

    A ball is convex, so a triangle with its three corners in one ball lies in that ball; the others are cut in four and
    asked again, at most `levels` times. False also means "not proven at this depth".
    """
    left = mesh.triangles
    for _ in range(max_subdivisions):
        inside = np.zeros(len(left), dtype=bool)
        for centre, radius in zip(spheres.centres, spheres.radii, strict=True):
            inside |= np.all(np.sum((left - centre) ** 2, axis=2) <= radius**2, axis=1)
        left = left[~inside]
        if len(left) == 0:
            return True
        if not are_covered(left.reshape(-1, 3), spheres).all():
            return False
        left = _subdivide(left)
    return False


def _subdivide(triangles: Array) -> Array:
    """Every triangle (t, 3, 3) cut at its edge midpoints: (4 t, 3, 3)."""
    a, b, c = np.moveaxis(triangles, 1, 0)
    ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
    parts = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
    return np.concatenate([np.stack(part, axis=1) for part in parts])


def required_inflation(mesh: Mesh, fixed: SphereSet, fitted: SphereSet, accuracy: float = 2e-5) -> float:
    """Least amount [m], to `accuracy`, by which `fitted` radii must grow until both sets are proven to cover `mesh`."""
    centres = np.vstack([fixed.centres, fitted.centres])

    def enough(amount: float) -> bool:
        return is_proven_covered(mesh, SphereSet(centres, np.concatenate([fixed.radii, fitted.radii + amount])))

    low, high = 0.0, 1e-4
    while not enough(high):
        low, high = high, 2 * high
    while high - low > accuracy:
        middle = 0.5 * (low + high)
        low, high = (low, middle) if enough(middle) else (middle, high)
    return high


def sample_union_surface(spheres: SphereSet, n_samples: int, rng: np.random.Generator) -> Array:
    """Points spread by area over the outer surface of the union of `balls`, from `count` draws before hiding."""
    share = spheres.radii**2 / np.sum(spheres.radii**2)
    owner = rng.choice(len(spheres.radii), size=n_samples, p=share)
    direction = rng.standard_normal((n_samples, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    points = spheres.centres[owner] + spheres.radii[owner, None] * direction
    return points[~are_covered(points, spheres, tolerance=-1e-9)]


def distance_outside(mesh: Mesh, points: Array) -> Array:
    """Distance [m] of each point to the solid inside `mesh`, 0 for points in it; `mesh` is convex and closed."""
    triangles = mesh.triangles
    closest = import_optional("trimesh.triangles").closest_point
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    length = np.linalg.norm(normals, axis=1)
    normals, triangles = normals[length > 0] / length[length > 0, None], triangles[length > 0]
    height = points @ normals.T - np.sum(normals * triangles[:, 0], axis=1)
    best = np.where(np.all(height <= 0, axis=1), 0.0, np.inf)
    for triangle in triangles:
        ask = best > 0
        near = closest(np.broadcast_to(triangle, (int(ask.sum()), 3, 3)), points[ask])
        best[ask] = np.minimum(best[ask], np.linalg.norm(points[ask] - np.asarray(near), axis=1))
    return best


def measure_excess(mesh: Mesh, spheres: SphereSet, n_samples: int, rng: np.random.Generator) -> Excess:
    """Excess of `balls` over the convex `mesh` from `count` draws on their surface and in their bounding box."""
    off = distance_outside(mesh, sample_union_surface(spheres, n_samples, rng))
    low = np.min(spheres.centres - spheres.radii[:, None], axis=0)
    high = np.max(spheres.centres + spheres.radii[:, None], axis=0)
    box = low + (high - low) * rng.random((n_samples, 3))
    in_balls, in_mesh = are_covered(box, spheres), distance_outside(mesh, box) <= 0
    ratio = float(np.sum(in_balls | in_mesh) / max(int(np.sum(in_mesh)), 1))
    return Excess(float(off.mean()), float(np.quantile(off, 0.95)), float(off.max()), ratio)
