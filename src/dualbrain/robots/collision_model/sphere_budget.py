"""Sphere cover of a whole robot within one budget of spheres: the same maximum excess for all convex parts.

For a maximum excess E a greedy set cover gives the number of spheres of each convex part (`sphere_fit`); E is bisected
until the budget suffices for all parts. Then the spheres are inflated until the surface of every part is verified to be
covered. The result is measured on the surface of the description with new random points:

- coverage: share of the surface inside a sphere, or enclosed by parts whose surface is verified to be covered;
- excess: distance of the outer surface of the spheres to the nearest sample of that surface, which is an upper bound.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dualbrain.robots.assets.mesh_primitives import concatenate_meshes
from dualbrain.robots.assets.meshes import Mesh
from dualbrain.robots.collision_model.convex_decomposition import decompose_convex
from dualbrain.robots.collision_model.coverage import SphereSet, are_covered, required_inflation, sample_union_surface
from dualbrain.robots.collision_model.fit_problem import FitProblem
from dualbrain.robots.collision_model.polytope import Polytope, convex_hull, sample_surface
from dualbrain.robots.collision_model.sphere_fit import fit_radii, greedy_cover_centres, refine_centres
from dualbrain.robots.optional_imports import import_optional

Array = NDArray[np.float64]

NO_SPHERES = SphereSet(np.empty((0, 3)), np.empty(0))
MAX_FIT_PLANES = 250
"""Maximum number of face planes of a solid in the fit."""
BURIED_DEPTH = 1e-3
"""Depth [m] inside another part of the same link at which a surface point need not be covered."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FitEffort:
    """Effort of the fit: surface points and candidate centres per part, bisections of the excess, refinement rounds.

    `n_samples` is the number of surface points for the measurement of each link.
    """

    n_points: int
    n_candidates: int
    n_bisections: int
    n_rounds: int
    n_samples: int


QUICK = FitEffort(n_points=250, n_candidates=300, n_bisections=9, n_rounds=0, n_samples=20_000)
FULL = FitEffort(n_points=600, n_candidates=1000, n_bisections=11, n_rounds=12, n_samples=60_000)


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkFit:
    """Spheres of one link and their measurement: shares of the surface, and the excess in metres."""

    spheres: SphereSet
    n_parts: int
    coverage: float
    mean: float
    p95: float
    worst: float


@dataclass(frozen=True, slots=True)
class _ConvexPart:
    solid: Polytope
    mesh: Mesh
    problem: FitProblem
    interior_points: Array


def fit_links(
    shapes: Mapping[str, Sequence[Mesh]], weights: Mapping[str, float], budget: int, effort: FitEffort, seed: int
) -> dict[str, LinkFit]:
    """At most `budget` spheres for all links, with an excess of at most E/w on a link of weight w.

    `shapes` are the meshes of each link, in the link frame; a link without meshes gets no spheres. Each link has a
    random generator of its own, so that a change of one link does not change the points of the others.
    """
    links = {
        name: _make_parts(meshes, effort, np.random.default_rng([seed, i]))
        for i, (name, meshes) in enumerate(shapes.items())
    }
    centres = _allocate_budget(links, weights, budget, effort)
    return {
        name: _finish_link(meshes, links[name], centres[name], effort, np.random.default_rng([seed, i, 1]))
        for i, (name, meshes) in enumerate(shapes.items())
    }


def _make_parts(meshes: Sequence[Mesh], effort: FitEffort, rng: np.random.Generator) -> list[_ConvexPart]:
    """Convex parts of a link with their fit problems, without surface points deep inside other parts."""
    hulls = [part for mesh in meshes for part in decompose_convex(mesh)]
    solids = [convex_hull(hull) for hull in hulls]
    made: list[_ConvexPart] = []
    for i, (hull, solid) in enumerate(zip(hulls, solids, strict=True)):
        candidates = hull.vertices[:: len(hull.vertices) // effort.n_points + 1]
        candidates = np.vstack([candidates, sample_surface(hull, effort.n_points, rng)])
        buried = np.zeros(len(candidates), dtype=bool)
        for j, other in enumerate(solids):
            if j != i:
                buried |= other.depth(candidates) > (BURIED_DEPTH if j > i else BURIED_DEPTH / 2)
        if buried.all():
            continue
        points, coarse = candidates[~buried], _coarsen(solid)
        made.append(
            _ConvexPart(
                solid,
                hull,
                FitProblem(coarse, np.ones(len(coarse.normals)), points, np.ones(len(points))),
                _sample_interior(hull, effort.n_candidates, rng),
            )
        )
    return made


def _coarsen(solid: Polytope) -> Polytope:
    """About `MAX_FIT_PLANES` planes of `solid`, one per direction, for the fit only; verification uses all planes."""
    if len(solid.normals) <= MAX_FIT_PLANES:
        return solid
    directions: Array = np.asarray(np.round(solid.normals / np.sqrt(12.0 / MAX_FIT_PLANES)), float)
    kept = np.unique(directions, axis=0, return_index=True)[1]
    return Polytope(solid.normals[kept], solid.offsets[kept])


def _sample_interior(hull: Mesh, n_samples: int, rng: np.random.Generator) -> Array:
    """Random points (n_samples, 3) inside a convex mesh, as weighted means of three surface points."""
    points = sample_surface(hull, 3 * n_samples, rng)
    return np.einsum("csd,cs->cd", points.reshape(n_samples, 3, 3), rng.dirichlet(np.ones(3), size=n_samples))


def _allocate_budget(
    links: Mapping[str, list[_ConvexPart]], weights: Mapping[str, float], budget: int, effort: FitEffort
) -> dict[str, list[Array]]:
    """Sphere centres of each part at the least maximum excess for which the budget suffices."""
    all_parts = [part for parts in links.values() for part in parts]
    size = max((float(np.max(np.ptp(part.mesh.vertices, axis=0))) for part in all_parts), default=0.0)
    low, high = 0.0, size * max(weights.values(), default=1.0)

    def cover(max_excess: float) -> dict[str, list[Array]]:
        return {
            name: [
                greedy_cover_centres(part.problem, max_excess / weights[name], part.interior_points) for part in parts
            ]
            for name, parts in links.items()
        }

    best = cover(high)
    for _ in range(effort.n_bisections):
        max_excess = 0.5 * (low + high)
        found = cover(max_excess)
        if sum(len(centres) for parts in found.values() for centres in parts) <= budget:
            high, best = max_excess, found
        else:
            low = max_excess
    return best


def _finish_link(
    meshes: Sequence[Mesh], parts: list[_ConvexPart], centres: list[Array], effort: FitEffort, rng: np.random.Generator
) -> LinkFit:
    """Refine the centres, inflate the spheres until the cover is verified, and measure the result."""
    if not parts:
        return LinkFit(spheres=NO_SPHERES, n_parts=0, coverage=1.0, mean=0.0, p95=0.0, worst=0.0)
    made: list[SphereSet] = []
    for part, initial in zip(parts, centres, strict=True):
        refined = refine_centres(part.problem, initial, effort.n_rounds) if effort.n_rounds else initial
        made.append(fit_radii(part.problem, refined))
    for i, part in enumerate(parts):
        others = _concatenate(made[:i] + made[i + 1 :])
        rounded = SphereSet(np.round(made[i].centres, 5), made[i].radii)
        inflated = np.ceil((made[i].radii + _inflation_for_part(part, parts, others, rounded)) * 1e5 - 1e-9) / 1e5
        made[i] = SphereSet(rounded.centres, inflated)
    return _measure_fit(concatenate_meshes(list(meshes)), parts, _concatenate(made), effort, rng)


def _inflation_for_part(part: _ConvexPart, parts: list[_ConvexPart], others: SphereSet, fitted: SphereSet) -> float:
    """Increase [m] of the `fitted` radii with which the faces of `part` that no other part buries are covered."""
    buried = np.zeros(len(part.mesh.faces), dtype=bool)
    for other in parts:
        if other is not part:
            depth = other.solid.depth(part.mesh.vertices)
            buried |= np.all(depth[part.mesh.faces] > BURIED_DEPTH, axis=1)
    return required_inflation(Mesh(part.mesh.vertices, part.mesh.faces[~buried]), others, fitted)


def _concatenate(sets: Sequence[SphereSet]) -> SphereSet:
    if not sets:
        return NO_SPHERES
    return SphereSet(np.vstack([one.centres for one in sets]), np.concatenate([one.radii for one in sets]))


def _measure_fit(
    surface: Mesh, parts: list[_ConvexPart], spheres: SphereSet, effort: FitEffort, rng: np.random.Generator
) -> LinkFit:
    """Coverage and excess of `spheres` against the surface of the description."""
    points = sample_surface(surface, effort.n_samples, rng)
    inside = are_covered(points, spheres, tolerance=1e-9)
    enclosed = inside.copy()
    if not inside.all():
        enclosed[~inside] = np.any([part.solid.depth(points[~inside]) > 1e-9 for part in parts], axis=0)
    outside = sample_union_surface(spheres, 3000, rng)
    outside = outside[np.all([part.solid.depth(outside) < 0.0 for part in parts], axis=0)]
    if len(outside) == 0:
        return LinkFit(
            spheres=spheres,
            n_parts=len(parts),
            coverage=float(enclosed.mean()),
            mean=0.0,
            p95=0.0,
            worst=0.0,
        )
    distance, _ = import_optional("scipy.spatial").cKDTree(np.vstack([points, surface.vertices])).query(outside)
    distance = np.asarray(distance, float)
    return LinkFit(
        spheres=spheres,
        n_parts=len(parts),
        coverage=float(enclosed.mean()),
        mean=float(distance.mean()),
        p95=float(np.quantile(distance, 0.95)),
        worst=float(distance.max()),
    )
