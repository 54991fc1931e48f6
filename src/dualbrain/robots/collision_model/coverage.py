"""Coverage of a mesh by spheres, verified on whole triangles, and their excess, measured on random points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dualbrain.robots.assets.meshes import Mesh
from dualbrain.robots.optional_imports import import_optional

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class SphereSet:
    """Spheres of one link: `centres` (b, 3) and `radii` (b,) in metres."""

    centres: Array
    radii: Array


@dataclass(frozen=True, slots=True)
class Excess:
    """Distance of the spheres' outer surface from the mesh [m], and volume of their union / volume of the mesh."""

    mean: float
    p95: float
    worst: float
    volume_ratio: float


def are_covered(points: Array, spheres: SphereSet, tolerance: float = 0.0) -> NDArray[np.bool_]:
    """Whether each point (p, 3) is in some sphere whose radius is increased by `tolerance` [m]; (p,)."""
    result = np.zeros(len(points), dtype=bool)
    for centre, radius in zip(spheres.centres, spheres.radii, strict=True):
        result |= np.sum((points - centre) ** 2, axis=1) <= (radius + tolerance) ** 2
    return result


def is_proven_covered(mesh: Mesh, spheres: SphereSet, max_subdivisions: int = 9) -> bool:
    """Whether every point of every face is verified to be in a sphere, for whole triangles instead of samples.

    A sphere is convex, so a triangle with its three corners in one sphere is inside that sphere. Every other triangle
    is divided into four, at most `max_subdivisions` times. False can also mean "not verified at this depth".
    """
    remaining = mesh.triangles
    for _ in range(max_subdivisions):
        inside = np.zeros(len(remaining), dtype=bool)
        for centre, radius in zip(spheres.centres, spheres.radii, strict=True):
            inside |= np.all(np.sum((remaining - centre) ** 2, axis=2) <= radius**2, axis=1)
        remaining = remaining[~inside]
        if len(remaining) == 0:
            return True
        if not are_covered(remaining.reshape(-1, 3), spheres).all():
            return False
        remaining = _subdivide(remaining)
    return False


def _subdivide(triangles: Array) -> Array:
    """Every triangle (t, 3, 3) divided at the midpoints of its edges: (4 t, 3, 3)."""
    a, b, c = np.moveaxis(triangles, 1, 0)
    ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
    parts = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
    return np.concatenate([np.stack(part, axis=1) for part in parts])


def required_inflation(mesh: Mesh, fixed: SphereSet, fitted: SphereSet, accuracy: float = 2e-5) -> float:
    """Least increase [m] of the `fitted` radii, to `accuracy`, with which both sets are verified to cover `mesh`."""
    centres = np.vstack([fixed.centres, fitted.centres])

    def suffices(amount: float) -> bool:
        return is_proven_covered(mesh, SphereSet(centres, np.concatenate([fixed.radii, fitted.radii + amount])))

    low, high = 0.0, 1e-4
    while not suffices(high):
        low, high = high, 2 * high
    while high - low > accuracy:
        middle = 0.5 * (low + high)
        low, high = (low, middle) if suffices(middle) else (middle, high)
    return high


def sample_union_surface(spheres: SphereSet, n_samples: int, rng: np.random.Generator) -> Array:
    """Points on the outer surface of the union of `spheres`, uniform by area: `n_samples` less those inside it."""
    share = spheres.radii**2 / np.sum(spheres.radii**2)
    owner = rng.choice(len(spheres.radii), size=n_samples, p=share)
    direction = rng.standard_normal((n_samples, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    points = spheres.centres[owner] + spheres.radii[owner, None] * direction
    return points[~are_covered(points, spheres, tolerance=-1e-9)]


def distance_outside(mesh: Mesh, points: Array) -> Array:
    """Distance [m] of each point to the solid inside `mesh`, which is convex and closed; 0 for points inside."""
    triangles = mesh.triangles
    closest = import_optional("trimesh.triangles").closest_point
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    length = np.linalg.norm(normals, axis=1)
    normals, triangles = normals[length > 0] / length[length > 0, None], triangles[length > 0]
    height = points @ normals.T - np.sum(normals * triangles[:, 0], axis=1)
    distance = np.where(np.all(height <= 0, axis=1), 0.0, np.inf)
    for triangle in triangles:
        outside = distance > 0
        nearest = closest(np.broadcast_to(triangle, (int(outside.sum()), 3, 3)), points[outside])
        to_triangle = np.linalg.norm(points[outside] - np.asarray(nearest), axis=1)
        distance[outside] = np.minimum(distance[outside], to_triangle)
    return distance


def measure_excess(mesh: Mesh, spheres: SphereSet, n_samples: int, rng: np.random.Generator) -> Excess:
    """Excess of `spheres` over the convex `mesh`, from `n_samples` points on their surface and in their bounds."""
    distance = distance_outside(mesh, sample_union_surface(spheres, n_samples, rng))
    low = np.min(spheres.centres - spheres.radii[:, None], axis=0)
    high = np.max(spheres.centres + spheres.radii[:, None], axis=0)
    points = low + (high - low) * rng.random((n_samples, 3))
    in_spheres, in_mesh = are_covered(points, spheres), distance_outside(mesh, points) <= 0
    ratio = float(np.sum(in_spheres | in_mesh) / max(int(np.sum(in_mesh)), 1))
    return Excess(float(distance.mean()), float(np.quantile(distance, 0.95)), float(distance.max()), ratio)
