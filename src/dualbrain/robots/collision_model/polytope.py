"""Convex solids as intersections of half-spaces, and random points on the surface of a mesh."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dualbrain.errors import ConfigurationError
from dualbrain.robots.assets.meshes import Mesh
from dualbrain.robots.optional_imports import import_optional

Array = NDArray[np.float64]

CONVEX_TOLERANCE = 1e-3
"""Largest depth [m] of a face inside the hull of a mesh that counts as convex."""


@dataclass(frozen=True, slots=True)
class Polytope:
    """The solid {x : normals @ x <= offsets}: unit outward `normals` (k, 3), `offsets` (k,) [m]."""

    normals: Array
    offsets: Array

    def slack(self, points: Array) -> Array:
        """Distance of each point to each face plane, positive inside [m]: (p, k) for points (p, 3)."""
        return self.offsets - points @ self.normals.T

    def depth(self, points: Array) -> Array:
        """Depth of each point inside the solid [m], (p,); outside it is negative and at least minus the distance.

        For c inside, the sphere (c, r) extends exactly r - depth(c) beyond the solid: at least, because the nearest
        face is a supporting plane; at most, because the distance to a solid is 1-Lipschitz.
        """
        return np.min(self.slack(points), axis=1)


def convex_hull(mesh: Mesh) -> Polytope:
    """The convex hull of `mesh`, with equal face planes merged.

    Raises:
        ConfigurationError: The mesh is not convex to within `CONVEX_TOLERANCE`, so its hull does not describe it.
    """
    hull = import_optional("scipy.spatial").ConvexHull(mesh.vertices)
    planes = np.unique(np.round(np.asarray(hull.equations, dtype=np.float64), 9), axis=0)
    polytope = Polytope(planes[:, :3], -planes[:, 3])
    deepest = float(np.max(polytope.depth(mesh.triangles.mean(axis=1))))
    if deepest > CONVEX_TOLERANCE:
        raise ConfigurationError(
            "collision mesh",
            got=f"a face {deepest * 1e3:.1f} mm inside its own hull",
            allowed=f"convex to {CONVEX_TOLERANCE * 1e3:.1f} mm",
            fix="Split the mesh into convex parts first.",
        )
    return polytope


def sample_surface(mesh: Mesh, n_samples: int, rng: np.random.Generator) -> Array:
    """Random points (n_samples, 3) on the surface of `mesh`, uniform by area."""
    faces = rng.choice(len(mesh.faces), size=n_samples, p=mesh.areas / mesh.areas.sum())
    a, b, c = np.moveaxis(mesh.triangles[faces], 1, 0)
    s, t = np.sqrt(rng.random((n_samples, 1))), rng.random((n_samples, 1))
    return (1 - s) * a + s * (1 - t) * b + s * t * c
