"""The fit is verified to cover the mesh, is reproducible, and gets tighter with more spheres."""

import numpy as np

from dualbrain.robots.collision_model.coverage import is_proven_covered
from dualbrain.robots.collision_model.fit_problem import LinkCoverSpec
from dualbrain.robots.collision_model.polytope import convex_hull
from dualbrain.robots.collision_model.sphere_fit import FitOptions, fit_cover
from tests.robots.panda_oracle import link_mesh

QUICK = FitOptions(n_points=150, n_candidates=300, n_starts=1, max_rounds=6, max_failed_moves=1)


def fit(count, *, seed=0, **options):
    return fit_cover(
        link_mesh("link7"), LinkCoverSpec(mesh="link7", n_spheres=count, **options), np.random.default_rng(seed), QUICK
    )


def max_excess(spheres):
    return np.max(spheres.radii - convex_hull(link_mesh("link7")).depth(spheres.centres))


def test_a_fit_is_verified_to_cover_the_mesh_and_reproducible():
    first, second = fit(6), fit(6)
    assert is_proven_covered(link_mesh("link7"), first)
    assert np.array_equal(first.centres, second.centres)
    assert np.array_equal(first.radii, second.radii)
    assert len(first.radii) == 6


def test_more_spheres_have_less_excess():
    assert max_excess(fit(10)) < 0.75 * max_excess(fit(3))


def test_a_face_of_higher_weight_gets_less_excess():
    down = np.array([0.0, 0.0, -1.0])

    def excess_below(spheres):
        return np.max(spheres.centres @ down + spheres.radii) - np.max(link_mesh("link7").vertices @ down)

    assert excess_below(fit(6, weighted_faces=(((0.0, 0.0, -1.0), 4.0),))) < 0.7 * excess_below(fit(6))


def test_fixed_spheres_are_unchanged():
    fixed = (((0.0, 0.0, 0.08), 0.05),)
    spheres = fit(5, fixed_spheres=fixed)
    assert tuple(spheres.centres[0]) == fixed[0][0]
    assert spheres.radii[0] == fixed[0][1]
    assert len(spheres.radii) == 5
    assert is_proven_covered(link_mesh("link7"), spheres)
