"""The fit: covers by proof, repeats itself, and gets tighter with more balls."""

import numpy as np

from dualbrain.robots.collision_model.coverage import is_proven_covered
from dualbrain.robots.collision_model.fit_problem import LinkCoverSpec
from dualbrain.robots.collision_model.polytope import convex_hull
from dualbrain.robots.collision_model.sphere_fit import FitOptions, fit_cover
from tests.robots.panda_oracle import link_mesh

QUICK = FitOptions(n_points=150, n_candidates=300, n_starts=1, max_rounds=6, max_failed_moves=1)


def fitted(count, *, seed=0, **wanted):
    return fit_cover(
        link_mesh("link7"), LinkCoverSpec(mesh="link7", n_spheres=count, **wanted), np.random.default_rng(seed), QUICK
    )


def bulge(balls):
    return np.max(balls.radii - convex_hull(link_mesh("link7")).depth(balls.centres))


def test_a_fit_covers_by_proof_and_repeats_itself():
    first, second = fitted(6), fitted(6)
    assert is_proven_covered(link_mesh("link7"), first)
    assert np.array_equal(first.centres, second.centres)
    assert np.array_equal(first.radii, second.radii)
    assert len(first.radii) == 6


def test_more_balls_bulge_less():
    assert bulge(fitted(10)) < 0.75 * bulge(fitted(3))


def test_a_heavier_face_gets_the_smaller_bulge():
    down = np.array([0.0, 0.0, -1.0])

    def below(balls):
        return np.max(balls.centres @ down + balls.radii) - np.max(link_mesh("link7").vertices @ down)

    assert below(fitted(6, weighted_faces=(((0.0, 0.0, -1.0), 4.0),))) < 0.7 * below(fitted(6))


def test_placed_balls_are_kept_as_they_are():
    placed = (((0.0, 0.0, 0.08), 0.05),)
    balls = fitted(5, fixed_spheres=placed)
    assert tuple(balls.centres[0]) == placed[0][0]
    assert balls.radii[0] == placed[0][1]
    assert len(balls.radii) == 5
    assert is_proven_covered(link_mesh("link7"), balls)
