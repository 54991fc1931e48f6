"""What is wanted of a cover, and the minimax problem that follows: weights of faces and points, cost of every ball."""

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
    """What is wanted for one link: its collision `mesh`, how many `balls`, and where a bulge hurts more or less.

    `faces`: (outward direction, weight) for faces whose normal lies within 37 degrees of it. `zones`: (axis, from [m],
    to [m], weight) for surface points in that slab. `placed`: (centre, radius) of balls put by hand and
    counted in `balls`; the others are fitted around them.
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
    """One start: the solid with its face weights (k,), surface points (p, 3) with theirs (p,)."""

    solid: Polytope
    face_weights: Array
    points: Array
    point_weights: Array

    def weighted_excess(self, centres: Array) -> Array:
        """Weighted bulge (p, b) that ball b has when it just reaches point p."""
        reach = np.linalg.norm(self.points[:, None] - centres[None], axis=2)
        slack = self.solid.slack(centres)
        cost = np.full_like(reach, -np.inf)
        for weight in np.unique(self.face_weights):
            depth = np.min(slack[:, self.face_weights == weight], axis=1)
            cost = np.maximum(cost, weight * (reach - depth))
        return self.point_weights[:, None] * cost


def make_fit_problem(
    mesh: Mesh, spec: LinkCoverSpec, fixed: SphereSet, n_samples: int, rng: np.random.Generator
) -> FitProblem:
    """The fit on the mesh's corners and `count` random surface points, less those that `placed` balls cover."""
    solid = convex_hull(mesh)
    points = np.vstack([mesh.vertices, sample_surface(mesh, n_samples, rng)])
    points = points[~are_covered(points, fixed)]
    return FitProblem(solid, spec.face_weights(solid.normals), points, spec.point_weights(points))
