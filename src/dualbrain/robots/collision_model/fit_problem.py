"""Specification of a sphere cover, and the resulting minimax problem: weights of faces and points, cost of spheres."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dualbrain.robots.assets.meshes import Mesh
from dualbrain.robots.collision_model.coverage import SphereSet, are_covered
from dualbrain.robots.collision_model.polytope import Polytope, convex_hull, sample_surface
from dualbrain.robots.model import Vector

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkCoverSpec:
    """Specification of the cover of one link: its collision `mesh`, the number of spheres, and weights of the excess.

    `weighted_faces`: (outward direction, weight) for faces whose normal is within 37° of the direction.
    `weighted_slabs`: (axis, lower [m], upper [m], weight) for surface points between both planes. `fixed_spheres`:
    (centre, radius) [m] of spheres placed by hand, which count in `n_spheres`; the others are fitted in addition.
    """

    mesh: str
    n_spheres: int
    weighted_faces: tuple[tuple[Vector, float], ...] = ()
    weighted_slabs: tuple[tuple[int, float, float, float], ...] = ()
    fixed_spheres: tuple[tuple[Vector, float], ...] = ()

    def face_weights(self, normals: Array) -> Array:
        """w_k of faces with outward unit `normals` (k, 3)."""
        weights = np.ones(len(normals))
        for direction, weight in self.weighted_faces:
            weights[normals @ np.array(direction) > 0.8] = weight
        return weights

    def point_weights(self, points: Array) -> Array:
        """w_p of surface points (p, 3)."""
        weights = np.ones(len(points))
        for axis, low, high, weight in self.weighted_slabs:
            weights[(points[:, axis] >= low) & (points[:, axis] <= high)] = weight
        return weights


@dataclass(frozen=True, slots=True)
class FitProblem:
    """The fit of one start: the solid with its face weights (k,), and surface points (p, 3) with their weights (p,)."""

    solid: Polytope
    face_weights: Array
    points: Array
    point_weights: Array

    def weighted_excess(self, centres: Array) -> Array:
        """Weighted excess (p, b) [m] of the sphere at centre b whose radius just reaches point p."""
        radius = np.linalg.norm(self.points[:, None] - centres[None], axis=2)
        slack = self.solid.slack(centres)
        excess = np.full_like(radius, -np.inf)
        for weight in np.unique(self.face_weights):
            depth = np.min(slack[:, self.face_weights == weight], axis=1)
            excess = np.maximum(excess, weight * (radius - depth))
        return self.point_weights[:, None] * excess


def make_fit_problem(
    mesh: Mesh, spec: LinkCoverSpec, fixed: SphereSet, n_samples: int, rng: np.random.Generator
) -> FitProblem:
    """The fit on the vertices and `n_samples` random surface points of `mesh` that the `fixed` spheres do not cover."""
    solid = convex_hull(mesh)
    points = np.vstack([mesh.vertices, sample_surface(mesh, n_samples, rng)])
    points = points[~are_covered(points, fixed)]
    return FitProblem(solid, spec.face_weights(solid.normals), points, spec.point_weights(points))
