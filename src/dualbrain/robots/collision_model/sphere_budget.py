"""Balls for a whole robot from one budget: the same bulge everywhere, more balls where the shape asks for them.

For a bulge bar E a greedy set cover says how many balls each convex part needs (sphere_fit.py); E is bisected until the
budget suffices for all parts together. Then the balls grow until every part's surface is proven covered. Measured
afterwards, on the description's own surface and with fresh random points:

- coverage: share of the surface inside a ball, or enclosed by parts whose surface is proven covered;
- excess: how far the outside of the balls stands off that surface (to its nearest sample: an upper bound).
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
BURIED_DEPTH = 1e-3
"""Surface points of one part this deep [m] inside another part of the same link need no ball."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FitEffort:
    """How hard to try: surface `points` and `candidates` a part, bisections of the bar, `polish` by alternation."""

    n_points: int
    n_candidates: int
    n_bisections: int
    n_rounds: int
    n_samples: int


QUICK = FitEffort(n_points=250, n_candidates=300, n_bisections=9, n_rounds=0, n_samples=20_000)
FULL = FitEffort(n_points=600, n_candidates=1000, n_bisections=11, n_rounds=12, n_samples=60_000)


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkFit:
    """Balls of one link and what was measured of them: shares, and lengths in metres."""

    spheres: SphereSet
    n_parts: int
    share_inside_spheres: float
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
    """At most `budget` balls over all links; a link of weight w may bulge bar/w. Links without shapes get none.

    Each link draws from its own generator, so that one link's change leaves the others' points alone.
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
    """Convex parts of a link with their fit problems, without what other parts bury."""
    hulls = [part for mesh in meshes for part in decompose_convex(mesh)]
    solids = [convex_hull(hull) for hull in hulls]
    made: list[_ConvexPart] = []
    for i, (hull, solid) in enumerate(zip(hulls, solids, strict=True)):
        every = hull.vertices[:: len(hull.vertices) // effort.n_points + 1]
        every = np.vstack([every, sample_surface(hull, effort.n_points, rng)])
        buried = np.zeros(len(every), dtype=bool)
        for j, other in enumerate(solids):
            if j != i:
                buried |= other.depth(every) > (BURIED_DEPTH if j > i else BURIED_DEPTH / 2)
        if buried.all():
            continue
        points, coarse = every[~buried], _coarsen(solid)
        alike = np.ones(len(coarse.normals))
        made.append(
            _ConvexPart(
                solid,
                hull,
                FitProblem(coarse, alike, points, np.ones(len(points))),
                _sample_interior(hull, effort.n_candidates, rng),
            )
        )
    return made


def _coarsen(solid: Polytope) -> Polytope:
    """About `PLANES` of the solid's planes, one a direction: by these the fit weighs bulges; nothing is proven so."""
    if len(solid.normals) <= MAX_FIT_PLANES:
        return solid
    directions: Array = np.asarray(np.round(solid.normals / np.sqrt(12.0 / MAX_FIT_PLANES)), float)
    kept = np.unique(directions, axis=0, return_index=True)[1]
    return Polytope(solid.normals[kept], solid.offsets[kept])


def _sample_interior(hull: Mesh, count: int, rng: np.random.Generator) -> Array:
    """Random points (count, 3) inside a convex mesh: means of its surface points."""
    points = sample_surface(hull, 3 * count, rng)
    return np.einsum("csd,cs->cd", points.reshape(count, 3, 3), rng.dirichlet(np.ones(3), size=count))


def _allocate_budget(
    links: Mapping[str, list[_ConvexPart]], weights: Mapping[str, float], budget: int, effort: FitEffort
) -> dict[str, list[Array]]:
    """Centres of each part at the least bulge bar for which the budget suffices."""
    every = [part for parts in links.values() for part in parts]
    size = max((float(np.max(np.ptp(part.mesh.vertices, axis=0))) for part in every), default=0.0)
    low, high = 0.0, size * max(weights.values(), default=1.0)

    def at(bar: float) -> dict[str, list[Array]]:
        return {
            name: [greedy_cover_centres(part.problem, bar / weights[name], part.interior_points) for part in parts]
            for name, parts in links.items()
        }

    best = at(high)
    for _ in range(effort.n_bisections):
        bar = 0.5 * (low + high)
        found = at(bar)
        if sum(len(centres) for parts in found.values() for centres in parts) <= budget:
            high, best = bar, found
        else:
            low = bar
    return best


def _finish_link(
    meshes: Sequence[Mesh], parts: list[_ConvexPart], centres: list[Array], effort: FitEffort, rng: np.random.Generator
) -> LinkFit:
    """Polish, grow until proven, measure."""
    if not parts:
        return LinkFit(
            spheres=NO_SPHERES, n_parts=0, share_inside_spheres=1.0, coverage=1.0, mean=0.0, p95=0.0, worst=0.0
        )
    made: list[SphereSet] = []
    for part, start in zip(parts, centres, strict=True):
        moved = refine_centres(part.problem, start, effort.n_rounds) if effort.n_rounds else start
        made.append(fit_radii(part.problem, moved))
    for i, part in enumerate(parts):
        others = _concatenate(made[:i] + made[i + 1 :])
        rounded = SphereSet(np.round(made[i].centres, 5), made[i].radii)
        grown = np.ceil((made[i].radii + _inflation_for_part(part, parts, others, rounded)) * 1e5 - 1e-9) / 1e5
        made[i] = SphereSet(rounded.centres, grown)
    return _measure_fit(concatenate_meshes(list(meshes)), parts, _concatenate(made), effort, rng)


def _inflation_for_part(part: _ConvexPart, parts: list[_ConvexPart], others: SphereSet, own: SphereSet) -> float:
    """How much `own` must grow to prove the cover of this part's faces, those buried in another part excepted."""
    buried = np.zeros(len(part.mesh.faces), dtype=bool)
    for other in parts:
        if other is not part:
            depth = other.solid.depth(part.mesh.vertices)
            buried |= np.all(depth[part.mesh.faces] > BURIED_DEPTH, axis=1)
    return required_inflation(Mesh(part.mesh.vertices, part.mesh.faces[~buried]), others, own)


def _concatenate(balls: Sequence[SphereSet]) -> SphereSet:
    if not balls:
        return NO_SPHERES
    return SphereSet(np.vstack([one.centres for one in balls]), np.concatenate([one.radii for one in balls]))


def _measure_fit(
    surface: Mesh, parts: list[_ConvexPart], balls: SphereSet, effort: FitEffort, rng: np.random.Generator
) -> LinkFit:
    """Coverage and excess against the description's own surface."""
    points = sample_surface(surface, effort.n_samples, rng)
    within = are_covered(points, balls, tolerance=1e-9)
    enclosed = within.copy()
    if not within.all():
        enclosed[~within] = np.any([part.solid.depth(points[~within]) > 1e-9 for part in parts], axis=0)
    outside = sample_union_surface(balls, 3000, rng)
    outside = outside[np.all([part.solid.depth(outside) < 0.0 for part in parts], axis=0)]
    if len(outside) == 0:
        return LinkFit(
            spheres=balls,
            n_parts=len(parts),
            share_inside_spheres=float(within.mean()),
            coverage=float(enclosed.mean()),
            mean=0.0,
            p95=0.0,
            worst=0.0,
        )
    off, _ = import_optional("scipy.spatial").cKDTree(np.vstack([points, surface.vertices])).query(outside)
    off = np.asarray(off, float)
    return LinkFit(
        spheres=balls,
        n_parts=len(parts),
        share_inside_spheres=float(within.mean()),
        coverage=float(enclosed.mean()),
        mean=float(off.mean()),
        p95=float(np.quantile(off, 0.95)),
        worst=float(off.max()),
    )
