"""Covers a convex solid with few balls that bulge out of it as little as can be.

The bulge of a ball (c, r) beyond a convex solid is r - depth(c) (polytope.py), so the cover is a minimax problem:

    minimise   max_p w_p max_k w_k (|p - c_i(p)| - slack_k(c_i(p)))     over centres c and owners i(p) of points p,

with a weight w_k for every face and w_p for every surface point: 2 where a bulge hurts twice as much (a finger tip),
0.5 where it hurts half as much (a face that another link hides).

1. For a bulge bar E the best ball at c has radius r(c) = min_k (slack_k(c) + E / w_k). Balls that no larger admissible
   ball contains have their centres on the medial surface, so random centres are first pushed onto it. A greedy set
   cover tells how many balls E needs; E is bisected until the wanted number suffices.
2. Alternation: each point goes to the ball that must grow least for it; each ball moves to the centre at which its own
   points need the least bulge. The second step is convex (a maximum of distances minus a minimum of affine functions)
   and is solved to 1 µm by cutting planes. Neither step can raise the maximum.
3. Trades leave local minima: the ball that is missed least is moved to where the bulge is largest.
4. The best of several starts is inflated until the cover is proven for whole triangles (sphere_cover.py).
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
    """How hard to try.

    Surface `points` and `candidates` per start, `starts`, `rounds` of alternation, failed `trades` that end a start.
    """

    n_points: int = 800
    n_candidates: int = 1500
    n_starts: int = 2
    max_rounds: int = 20
    max_failed_moves: int = 4
    n_bisections: int = 9


def fit_cover(mesh: Mesh, spec: LinkCoverSpec, rng: np.random.Generator, options: FitOptions) -> SphereSet:
    """`wanted.balls` balls that cover all of `mesh`'s surface, proven, with small bulge.

    Deterministic for equal inputs and generator state.
    """
    placed = SphereSet(
        np.array([centre for centre, _ in spec.fixed_spheres]).reshape(-1, 3),
        np.array([radius for _, radius in spec.fixed_spheres]),
    )
    best: Array | None = None
    best_bulge = np.inf
    for _ in range(options.n_starts):
        problem = make_fit_problem(mesh, spec, placed, options.n_points, rng)
        start = _initial_centres(problem, spec.n_spheres - len(placed.radii), rng, options)
        centres, bulge = _relocate_spheres(problem, *_alternate(problem, start, options.max_rounds), options)
        if bulge < best_bulge:
            best, best_bulge = centres, bulge
    assert best is not None
    problem = make_fit_problem(mesh, spec, placed, 10 * options.n_points, rng)
    centres, _ = _alternate(problem, best, options.max_rounds)
    return _inflate(mesh, placed, fit_radii(problem, centres))


def greedy_cover_centres(problem: FitProblem, max_excess: float, interior_points: Array) -> Array:
    """Centres (b, 3) of a greedy cover of all points by balls that bulge at most `bar` [m], from points `inside`.

    Points that no candidate reaches get balls of their own, centred below them.
    """
    centres = _push_to_medial_surface(problem.solid, max_excess / problem.face_weights, interior_points)
    covers = max_excess >= problem.weighted_excess(centres).T
    reached = covers.any(axis=0)
    picked = _greedy_set_cover(covers[:, reached], len(centres)) or []
    left, own = problem.points[~reached], list(centres[picked])
    middle = interior_points.mean(axis=0)
    while len(left):
        inward = middle - left[0]
        step = min(1.0, 0.5 * max_excess / max(float(np.linalg.norm(inward)), 1e-9))
        own.append(left[0] + step * inward)
        reach = max(max_excess, float(np.linalg.norm(left[0] - own[-1])))
        left = left[np.linalg.norm(left - own[-1], axis=1) > reach]
    return np.array(own).reshape(-1, 3)


def refine_centres(problem: FitProblem, centres: Array, rounds: int) -> Array:
    """Centres after `rounds` of alternation."""
    return _alternate(problem, centres, rounds)[0]


def _initial_centres(problem: FitProblem, count: int, rng: np.random.Generator, options: FitOptions) -> Array:
    """Centres (count, 3) of a greedy cover at the smallest bulge bar found by bisection."""
    points = problem.points
    low, high = 0.0, float(np.max(np.ptp(points, axis=0)))
    seeds = points[rng.integers(len(points), size=(options.n_candidates, 3))]
    inside = np.einsum("csd,cs->cd", seeds, rng.dirichlet(np.ones(3), size=options.n_candidates))
    chosen = inside[:count]
    for _ in range(options.n_bisections):
        bar = 0.5 * (low + high)
        centres = _push_to_medial_surface(problem.solid, bar / problem.face_weights, inside)
        picked = _greedy_set_cover(bar >= problem.weighted_excess(centres).T, count)
        if picked is None:
            low = bar
        else:
            high, chosen = bar, centres[picked]
    return np.vstack([chosen, inside[: count - len(chosen)]])


def _push_to_medial_surface(solid: Polytope, max_excess: Array, centres: Array) -> Array:
    """Pushes centres off the one face i that holds their ball until a second face does; the ball only grows.

    Moving by t along the inward normal m = -n_i keeps the old ball inside the new one of radius r + t; face j allows
    slack_j + bar_j - t n_j.m >= r + t, so t = min_j (slack_j + bar_j - r) / (1 + n_j.m).
    """
    slack = solid.slack(centres) + max_excess
    touching = np.argmin(slack, axis=1)
    radius = slack[np.arange(len(centres)), touching]
    inward = -solid.normals[touching]
    room = 1.0 + inward @ solid.normals.T
    steps = np.where(room > 1e-6, (slack - radius[:, None]) / np.maximum(room, 1e-6), np.inf)
    return centres + np.min(steps, axis=1)[:, None] * inward


def _greedy_set_cover(covers: NDArray[np.bool_], count: int) -> list[int] | None:
    """At most `count` rows of `covers` (balls, points) that reach every point, largest gain first; None if too few."""
    left = np.ones(covers.shape[1], dtype=bool)
    counts = covers.astype(np.float32)
    picked: list[int] = []
    while left.any() and len(picked) < count:
        gain = counts @ left.astype(np.float32)
        best = int(np.argmax(gain))
        if not gain[best]:
            return None
        picked.append(best)
        left &= ~covers[best]
    return None if left.any() else picked


def _alternate(problem: FitProblem, centres: Array, rounds: int) -> tuple[Array, float]:
    """Assign points, move balls, until the largest bulge stops falling; returns the best centres and their bulge."""
    best, best_bulge, stalled = centres, np.inf, 0
    before = np.full(len(problem.points), -1)
    for _ in range(rounds):
        cost = problem.weighted_excess(centres)
        owner = np.argmin(cost, axis=1)
        bulge = float(np.max(np.min(cost, axis=1)))
        stalled = 0 if bulge < best_bulge - 2e-5 else stalled + 1
        if bulge < best_bulge:
            best, best_bulge = centres, bulge
        if stalled > 2:
            break
        stay = [np.array_equal(owner == i, before == i) for i in range(len(centres))]
        centres = np.array([c if stay[i] else _minimize_excess(problem, owner == i, c) for i, c in enumerate(centres)])
        before = owner
    return best, best_bulge


def _relocate_spheres(problem: FitProblem, centres: Array, bulge: float, options: FitOptions) -> tuple[Array, float]:
    """Moves the ball that is missed least to where the bulge is largest and alternates again, while that helps.

    The trades are tried in the order of how little the removed ball is missed; the new ball starts at the worst point
    pulled half way to its owner.
    """
    tried = 0
    while tried < options.max_failed_moves:
        cost = problem.weighted_excess(centres)
        missed = [float(np.max(np.min(np.delete(cost, i, axis=1), axis=1))) for i in range(len(centres))]
        worst = int(np.argmax(np.min(cost, axis=1)))
        owner = int(np.argmin(cost[worst]))
        order = [int(i) for i in np.argsort(missed, kind="stable") if i != owner]
        moved = centres.copy()
        moved[order[tried % len(order)]] = 0.5 * (problem.points[worst] + centres[owner])
        fresh, fresh_bulge = _alternate(problem, moved, options.max_rounds)
        if fresh_bulge < bulge - 2e-5:
            centres, bulge, tried = fresh, fresh_bulge, 0
        else:
            tried += 1
    return centres, bulge


def _minimize_excess(problem: FitProblem, owned: NDArray[np.bool_], centre: Array) -> Array:
    """Centre c that minimises max over my points p and faces k of w_p w_k (|p - c| - slack_k(c)): convex.

    Cutting planes, one set per point weight w: unknowns (c, r, t), minimise t with w w_k (r - slack_k(c)) <= t and
    r >= u.(p - c) for unit vectors u, each a valid lower bound of |p - c|; every round adds the directions to the
    farthest points at the newest c. Points of lesser weight get their own r.
    """
    classes = [
        (w, problem.points[owned & (problem.point_weights == w)]) for w in np.unique(problem.point_weights[owned])
    ]
    if not classes:
        return centre
    rows, limits = _face_rows(problem, [w for w, _ in classes])
    best, best_bulge = centre, np.inf
    for turn in range(12):
        slack = problem.solid.slack(centre[None])[0]
        bulge = -np.inf
        for i, (weight, points) in enumerate(classes):
            offsets = points - centre
            reach = np.linalg.norm(offsets, axis=1)
            bulge = max(bulge, float(weight * np.max(problem.face_weights * (reach.max() - slack))))
            far = np.argsort(-reach, kind="stable")[:12]
            units = offsets[far] / np.maximum(reach[far, None], 1e-9)
            cut = np.zeros((len(far), 4 + len(classes)))
            cut[:, :3], cut[:, 3 + i] = -units, -1.0
            rows, limits = np.vstack([rows, cut]), np.concatenate([limits, -np.sum(units * points[far], axis=1)])
        if bulge > best_bulge - 1e-6 and turn > 1:
            break
        if bulge < best_bulge:
            best, best_bulge = centre, bulge
        target = np.eye(4 + len(classes))[-1]
        answer = import_optional("scipy.optimize").linprog(
            target, A_ub=rows, b_ub=limits, bounds=[(None, None)] * len(target), method="highs"
        )
        if answer.status != 0:
            break
        centre = np.asarray(answer.x[:3], dtype=np.float64)
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
    """Smallest radii with which the balls cover the points they own."""
    owner = np.argmin(problem.weighted_excess(centres), axis=1)
    reach = np.linalg.norm(problem.points - centres[owner], axis=1)
    return SphereSet(centres, np.array([reach[owner == i].max(initial=1e-3) for i in range(len(centres))]))


def _inflate(mesh: Mesh, placed: SphereSet, fitted: SphereSet) -> SphereSet:
    """All balls, the fitted ones grown alike by the least amount that proves the cover; radii rounded up to 10 µm."""
    rounded = SphereSet(np.round(fitted.centres, 5), fitted.radii)
    grown = np.ceil((fitted.radii + required_inflation(mesh, placed, rounded)) * 1e5 - 1e-9) / 1e5
    return SphereSet(np.vstack([placed.centres, rounded.centres]), np.concatenate([placed.radii, grown]))
