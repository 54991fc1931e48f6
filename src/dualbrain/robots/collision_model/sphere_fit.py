"""Covers a convex solid with a given number of spheres and minimal excess.

The excess of a sphere (c, r) beyond a convex solid is r - depth(c) (`polytope`), so the cover is a minimax problem:

    minimise   max_p w_p max_k w_k (|p - c_i(p)| - slack_k(c_i(p)))     over centres c and owners i(p) of points p,

with a weight w_k of every face and w_p of every surface point: 2 where an excess costs twice as much (a finger tip),
0.5 where it costs half as much (a face that another link hides).

1. For a maximum excess E the best sphere at c has the radius r(c) = min_k (slack_k(c) + E / w_k). Spheres that no
   larger admissible sphere contains have their centres on the medial surface, so random centres are first moved onto
   it. A greedy set cover gives the number of spheres for E; E is bisected until the given number suffices.
2. Alternation: each point is assigned to the sphere with the least increase of radius; each sphere moves to the centre
   at which its points need the least excess. The second step is convex (a maximum of distances minus a minimum of
   affine functions) and is solved to 1 µm by cutting planes. Neither step can increase the maximum.
3. Relocation leaves local minima: the sphere whose removal costs least is moved to the point of the largest excess.
4. The best of several starts is inflated until the cover is verified for whole triangles (`coverage`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dualbrain.robots.assets.meshes import Mesh
from dualbrain.robots.collision_model.coverage import SphereSet, required_inflation
from dualbrain.robots.collision_model.fit_problem import FitProblem, LinkCoverSpec, make_fit_problem
from dualbrain.robots.collision_model.polytope import Polytope
from dualbrain.robots.optional_imports import import_optional

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True)
class FitOptions:
    """Effort of the fit.

    Surface points and candidate centres per start, number of starts, rounds of alternation, failed relocations that end
    a start, and bisections of the excess.
    """

    n_points: int = 800
    n_candidates: int = 1500
    n_starts: int = 2
    max_rounds: int = 20
    max_failed_moves: int = 4
    n_bisections: int = 9


def fit_cover(mesh: Mesh, spec: LinkCoverSpec, rng: np.random.Generator, options: FitOptions) -> SphereSet:
    """`spec.n_spheres` spheres with small excess that are verified to cover the whole surface of `mesh`.

    Deterministic for equal inputs and an equal state of the generator.
    """
    fixed = SphereSet(
        np.array([centre for centre, _ in spec.fixed_spheres]).reshape(-1, 3),
        np.array([radius for _, radius in spec.fixed_spheres]),
    )
    best: Array | None = None
    best_excess = np.inf
    for _ in range(options.n_starts):
        problem = make_fit_problem(mesh, spec, fixed, options.n_points, rng)
        initial = _initial_centres(problem, spec.n_spheres - len(fixed.radii), rng, options)
        centres, excess = _relocate_spheres(problem, *_alternate(problem, initial, options.max_rounds), options)
        if excess < best_excess:
            best, best_excess = centres, excess
    assert best is not None
    problem = make_fit_problem(mesh, spec, fixed, 10 * options.n_points, rng)
    centres, _ = _alternate(problem, best, options.max_rounds)
    return _inflate(mesh, fixed, fit_radii(problem, centres))


def greedy_cover_centres(problem: FitProblem, max_excess: float, interior_points: Array) -> Array:
    """Centres (b, 3) of a greedy cover of all points by spheres with an excess of at most `max_excess` [m].

    The candidates are `interior_points` (c, 3), moved to the medial surface. A point that no candidate covers gets an
    additional sphere, whose centre is below the point.
    """
    candidates = _push_to_medial_surface(problem.solid, max_excess / problem.face_weights, interior_points)
    covers = max_excess >= problem.weighted_excess(candidates).T
    reached = covers.any(axis=0)
    picked = _greedy_set_cover(covers[:, reached], len(candidates)) or []
    uncovered, centres = problem.points[~reached], list(candidates[picked])
    middle = interior_points.mean(axis=0)
    while len(uncovered):
        inward = middle - uncovered[0]
        step = min(1.0, 0.5 * max_excess / max(float(np.linalg.norm(inward)), 1e-9))
        centres.append(uncovered[0] + step * inward)
        radius = max(max_excess, float(np.linalg.norm(uncovered[0] - centres[-1])))
        uncovered = uncovered[np.linalg.norm(uncovered - centres[-1], axis=1) > radius]
    return np.array(centres).reshape(-1, 3)


def refine_centres(problem: FitProblem, centres: Array, rounds: int) -> Array:
    """Centres (b, 3) after `rounds` of alternation."""
    return _alternate(problem, centres, rounds)[0]


def _initial_centres(problem: FitProblem, n_spheres: int, rng: np.random.Generator, options: FitOptions) -> Array:
    """Centres (n_spheres, 3) of a greedy cover at the smallest maximum excess found by bisection."""
    points = problem.points
    low, high = 0.0, float(np.max(np.ptp(points, axis=0)))
    corners = points[rng.integers(len(points), size=(options.n_candidates, 3))]
    interior = np.einsum("csd,cs->cd", corners, rng.dirichlet(np.ones(3), size=options.n_candidates))
    chosen = interior[:n_spheres]
    for _ in range(options.n_bisections):
        max_excess = 0.5 * (low + high)
        centres = _push_to_medial_surface(problem.solid, max_excess / problem.face_weights, interior)
        picked = _greedy_set_cover(max_excess >= problem.weighted_excess(centres).T, n_spheres)
        if picked is None:
            low = max_excess
        else:
            high, chosen = max_excess, centres[picked]
    return np.vstack([chosen, interior[: n_spheres - len(chosen)]])


def _push_to_medial_surface(solid: Polytope, max_excess: Array, centres: Array) -> Array:
    """Move each centre away from the face i that limits its sphere until a second face does; the sphere only grows.

    Moving by t along the inward normal m = -n_i keeps the old sphere inside the new one of radius r + t. Face j with
    the maximum excess E_j allows slack_j + E_j - t n_j.m >= r + t, so t = min_j (slack_j + E_j - r) / (1 + n_j.m).
    """
    slack = solid.slack(centres) + max_excess
    touching = np.argmin(slack, axis=1)
    radius = slack[np.arange(len(centres)), touching]
    inward = -solid.normals[touching]
    slope = 1.0 + inward @ solid.normals.T
    steps = np.where(slope > 1e-6, (slack - radius[:, None]) / np.maximum(slope, 1e-6), np.inf)
    return centres + np.min(steps, axis=1)[:, None] * inward


def _greedy_set_cover(covers: NDArray[np.bool_], max_rows: int) -> list[int] | None:
    """At most `max_rows` rows of `covers` (spheres, points) that cover all points, largest gain first; else None."""
    uncovered = np.ones(covers.shape[1], dtype=bool)
    counts = covers.astype(np.float32)
    picked: list[int] = []
    while uncovered.any() and len(picked) < max_rows:
        gain = counts @ uncovered.astype(np.float32)
        best = int(np.argmax(gain))
        if not gain[best]:
            return None
        picked.append(best)
        uncovered &= ~covers[best]
    return None if uncovered.any() else picked


def _alternate(problem: FitProblem, centres: Array, rounds: int) -> tuple[Array, float]:
    """Assign points and move spheres until the maximum excess stops falling; the best centres and their excess."""
    best, best_excess, stalled = centres, np.inf, 0
    previous_owner = np.full(len(problem.points), -1)
    for _ in range(rounds):
        cost = problem.weighted_excess(centres)
        owner = np.argmin(cost, axis=1)
        excess = float(np.max(np.min(cost, axis=1)))
        stalled = 0 if excess < best_excess - 2e-5 else stalled + 1
        if excess < best_excess:
            best, best_excess = centres, excess
        if stalled > 2:
            break
        stay = [np.array_equal(owner == i, previous_owner == i) for i in range(len(centres))]
        centres = np.array([c if stay[i] else _minimize_excess(problem, owner == i, c) for i, c in enumerate(centres)])
        previous_owner = owner
    return best, best_excess


def _relocate_spheres(problem: FitProblem, centres: Array, excess: float, options: FitOptions) -> tuple[Array, float]:
    """Move the sphere whose removal costs least to the point of the largest excess and alternate, while that helps.

    Spheres are tried in the order of the cost of their removal; the new centre is half way between the worst point and
    the centre of its owner.
    """
    failed = 0
    while failed < options.max_failed_moves:
        cost = problem.weighted_excess(centres)
        removal_cost = [float(np.max(np.min(np.delete(cost, i, axis=1), axis=1))) for i in range(len(centres))]
        worst = int(np.argmax(np.min(cost, axis=1)))
        owner = int(np.argmin(cost[worst]))
        order = [int(i) for i in np.argsort(removal_cost, kind="stable") if i != owner]
        moved = centres.copy()
        moved[order[failed % len(order)]] = 0.5 * (problem.points[worst] + centres[owner])
        new_centres, new_excess = _alternate(problem, moved, options.max_rounds)
        if new_excess < excess - 2e-5:
            centres, excess, failed = new_centres, new_excess, 0
        else:
            failed += 1
    return centres, excess


def _minimize_excess(problem: FitProblem, owned: NDArray[np.bool_], centre: Array) -> Array:
    """Centre c that minimises the maximum over owned points p and faces k of w_p w_k (|p - c| - slack_k(c)).

    The problem is convex and is solved by cutting planes, one set per point weight w: the unknowns are (c, r, t);
    minimise t with w w_k (r - slack_k(c)) <= t and r >= u.(p - c) for unit vectors u, each a valid lower bound of
    |p - c|. Every round adds the directions to the farthest points at the latest c. Each point weight has its own r.
    """
    classes = [
        (w, problem.points[owned & (problem.point_weights == w)]) for w in np.unique(problem.point_weights[owned])
    ]
    if not classes:
        return centre
    rows, limits = _face_rows(problem, [w for w, _ in classes])
    best, best_excess = centre, np.inf
    for iteration in range(12):
        slack = problem.solid.slack(centre[None])[0]
        excess = -np.inf
        for i, (weight, points) in enumerate(classes):
            offsets = points - centre
            distance = np.linalg.norm(offsets, axis=1)
            excess = max(excess, float(weight * np.max(problem.face_weights * (distance.max() - slack))))
            far = np.argsort(-distance, kind="stable")[:12]
            units = offsets[far] / np.maximum(distance[far, None], 1e-9)
            cut = np.zeros((len(far), 4 + len(classes)))
            cut[:, :3], cut[:, 3 + i] = -units, -1.0
            rows, limits = np.vstack([rows, cut]), np.concatenate([limits, -np.sum(units * points[far], axis=1)])
        if excess > best_excess - 1e-6 and iteration > 1:
            break
        if excess < best_excess:
            best, best_excess = centre, excess
        objective = np.eye(4 + len(classes))[-1]
        solution = import_optional("scipy.optimize").linprog(
            objective, A_ub=rows, b_ub=limits, bounds=[(None, None)] * len(objective), method="highs"
        )
        if solution.status != 0:
            break
        centre = np.asarray(solution.x[:3], dtype=np.float64)
    return best


def _face_rows(problem: FitProblem, weights: list[float]) -> tuple[Array, Array]:
    """Rows and limits of w w_k (r_w - offset_k + n_k.c) <= t for every point weight w; unknowns (c, r_w..., t)."""
    blocks: list[Array] = []
    for i, weight in enumerate(weights):
        w = weight * problem.face_weights
        block = np.zeros((len(w), 4 + len(weights)))
        block[:, :3], block[:, 3 + i], block[:, -1] = w[:, None] * problem.solid.normals, w, -1.0
        blocks.append(block)
    limits = np.concatenate([weight * problem.face_weights * problem.solid.offsets for weight in weights])
    return np.vstack(blocks), limits


def fit_radii(problem: FitProblem, centres: Array) -> SphereSet:
    """Smallest radii with which the spheres at `centres` cover the points that they own."""
    owner = np.argmin(problem.weighted_excess(centres), axis=1)
    distance = np.linalg.norm(problem.points - centres[owner], axis=1)
    return SphereSet(centres, np.array([distance[owner == i].max(initial=1e-3) for i in range(len(centres))]))


def _inflate(mesh: Mesh, fixed: SphereSet, fitted: SphereSet) -> SphereSet:
    """All spheres, with the fitted radii increased by the least amount that covers `mesh` and rounded up to 10 µm."""
    rounded = SphereSet(np.round(fitted.centres, 5), fitted.radii)
    inflated = np.ceil((fitted.radii + required_inflation(mesh, fixed, rounded)) * 1e5 - 1e-9) / 1e5
    return SphereSet(np.vstack([fixed.centres, rounded.centres]), np.concatenate([fixed.radii, inflated]))
