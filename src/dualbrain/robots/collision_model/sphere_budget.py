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

from dualbrain.robots.assets.mesh_primitives import joined
from dualbrain.robots.assets.meshes import Mesh
from dualbrain.robots.collision_model.convex_decomposition import convex_parts
from dualbrain.robots.collision_model.coverage import Balls, covered, proven_inflation, union_surface
from dualbrain.robots.collision_model.fit_problem import Problem
from dualbrain.robots.collision_model.polytope import Polytope, convex_hull, surface_points
from dualbrain.robots.collision_model.sphere_fit import balls_within, polished, reaching
from dualbrain.robots.optional_imports import extra

Array = NDArray[np.float64]

NONE = Balls(np.empty((0, 3)), np.empty(0))
PLANES = 250
BURIED = 1e-3
"""Surface points of one part this deep [m] inside another part of the same link need no ball."""


@dataclass(frozen=True, slots=True)
class Effort:
    """How hard to try: surface `points` and `candidates` a part, bisections of the bar, `polish` by alternation."""

    points: int
    candidates: int
    bisections: int
    rounds: int
    samples: int


QUICK = Effort(points=250, candidates=300, bisections=9, rounds=0, samples=20_000)
FULL = Effort(points=600, candidates=1000, bisections=11, rounds=12, samples=60_000)


@dataclass(frozen=True, slots=True)
class Fit:
    """Balls of one link and what was measured of them: shares, and lengths in metres."""

    balls: Balls
    parts: int
    in_balls: float
    coverage: float
    mean: float
    p95: float
    worst: float


@dataclass(frozen=True, slots=True)
class _Part:
    solid: Polytope
    mesh: Mesh
    problem: Problem
    inside: Array


def fit_all(
    shapes: Mapping[str, Sequence[Mesh]], weights: Mapping[str, float], budget: int, effort: Effort, seed: int
) -> dict[str, Fit]:
    """At most `budget` balls over all links; a link of weight w may bulge bar/w. Links without shapes get none.

    Each link draws from its own generator, so that one link's change leaves the others' points alone.
    """
    links = {
        name: _parts(meshes, effort, np.random.default_rng([seed, i]))
        for i, (name, meshes) in enumerate(shapes.items())
    }
    centres = _share_out(links, weights, budget, effort)
    return {
        name: _finish(meshes, links[name], centres[name], effort, np.random.default_rng([seed, i, 1]))
        for i, (name, meshes) in enumerate(shapes.items())
    }


def _parts(meshes: Sequence[Mesh], effort: Effort, rng: np.random.Generator) -> list[_Part]:
    """Convex parts of a link with their fit problems, without what other parts bury."""
    hulls = [part for mesh in meshes for part in convex_parts(mesh)]
    solids = [convex_hull(hull) for hull in hulls]
    made: list[_Part] = []
    for i, (hull, solid) in enumerate(zip(hulls, solids, strict=True)):
        every = hull.vertices[:: len(hull.vertices) // effort.points + 1]
        every = np.vstack([every, surface_points(hull, effort.points, rng)])
        buried = np.zeros(len(every), dtype=bool)
        for j, other in enumerate(solids):
            if j != i:
                buried |= other.depth(every) > (BURIED if j > i else BURIED / 2)
        if buried.all():
            continue
        points, coarse = every[~buried], _coarse(solid)
        alike = np.ones(len(coarse.normals))
        made.append(_Part(solid, hull, Problem(coarse, alike, points, np.ones(len(points))),
                          _inside(hull, effort.candidates, rng)))  # fmt: skip
    return made


def _coarse(solid: Polytope) -> Polytope:
    """About `PLANES` of the solid's planes, one a direction: by these the fit weighs bulges; nothing is proven so."""
    if len(solid.normals) <= PLANES:
        return solid
    directions: Array = np.asarray(np.round(solid.normals / np.sqrt(12.0 / PLANES)), float)
    kept = np.unique(directions, axis=0, return_index=True)[1]
    return Polytope(solid.normals[kept], solid.offsets[kept])


def _inside(hull: Mesh, count: int, rng: np.random.Generator) -> Array:
    """Random points (count, 3) inside a convex mesh: means of its surface points."""
    points = surface_points(hull, 3 * count, rng)
    return np.einsum("csd,cs->cd", points.reshape(count, 3, 3), rng.dirichlet(np.ones(3), size=count))


def _share_out(
    links: Mapping[str, list[_Part]], weights: Mapping[str, float], budget: int, effort: Effort
) -> dict[str, list[Array]]:
    """Centres of each part at the least bulge bar for which the budget suffices."""
    every = [part for parts in links.values() for part in parts]
    size = max((float(np.max(np.ptp(part.mesh.vertices, axis=0))) for part in every), default=0.0)
    low, high = 0.0, size * max(weights.values(), default=1.0)

    def at(bar: float) -> dict[str, list[Array]]:
        return {
            name: [balls_within(part.problem, bar / weights[name], part.inside) for part in parts]
            for name, parts in links.items()
        }

    best = at(high)
    for _ in range(effort.bisections):
        bar = 0.5 * (low + high)
        found = at(bar)
        if sum(len(centres) for parts in found.values() for centres in parts) <= budget:
            high, best = bar, found
        else:
            low = bar
    return best


def _finish(
    meshes: Sequence[Mesh], parts: list[_Part], centres: list[Array], effort: Effort, rng: np.random.Generator
) -> Fit:  # fmt: skip
    """Polish, grow until proven, measure."""
    if not parts:
        return Fit(NONE, 0, 1.0, 1.0, 0.0, 0.0, 0.0)
    made: list[Balls] = []
    for part, start in zip(parts, centres, strict=True):
        moved = polished(part.problem, start, effort.rounds) if effort.rounds else start
        made.append(reaching(part.problem, moved))
    for i, part in enumerate(parts):
        others = _together(made[:i] + made[i + 1 :])
        rounded = Balls(np.round(made[i].centres, 5), made[i].radii)
        grown = np.ceil((made[i].radii + _needed(part, parts, others, rounded)) * 1e5 - 1e-9) / 1e5
        made[i] = Balls(rounded.centres, grown)
    return _measured(joined(list(meshes)), parts, _together(made), effort, rng)


def _needed(part: _Part, parts: list[_Part], others: Balls, own: Balls) -> float:
    """How much `own` must grow to prove the cover of this part's faces, those buried in another part excepted."""
    buried = np.zeros(len(part.mesh.faces), dtype=bool)
    for other in parts:
        if other is not part:
            depth = other.solid.depth(part.mesh.vertices)
            buried |= np.all(depth[part.mesh.faces] > BURIED, axis=1)
    return proven_inflation(Mesh(part.mesh.vertices, part.mesh.faces[~buried]), others, own)


def _together(balls: Sequence[Balls]) -> Balls:
    if not balls:
        return NONE
    return Balls(np.vstack([one.centres for one in balls]), np.concatenate([one.radii for one in balls]))


def _measured(surface: Mesh, parts: list[_Part], balls: Balls, effort: Effort, rng: np.random.Generator) -> Fit:
    """Coverage and excess against the description's own surface."""
    points = surface_points(surface, effort.samples, rng)
    within = covered(points, balls, tolerance=1e-9)
    enclosed = within.copy()
    if not within.all():
        enclosed[~within] = np.any([part.solid.depth(points[~within]) > 1e-9 for part in parts], axis=0)
    outside = union_surface(balls, 3000, rng)
    outside = outside[np.all([part.solid.depth(outside) < 0.0 for part in parts], axis=0)]
    if len(outside) == 0:
        return Fit(balls, len(parts), float(within.mean()), float(enclosed.mean()), 0.0, 0.0, 0.0)
    off, _ = extra("scipy.spatial").cKDTree(np.vstack([points, surface.vertices])).query(outside)
    off = np.asarray(off, float)
    return Fit(
        balls, len(parts), float(within.mean()), float(enclosed.mean()), float(off.mean()),
        float(np.quantile(off, 0.95)), float(off.max()),
    )  # fmt: skip
