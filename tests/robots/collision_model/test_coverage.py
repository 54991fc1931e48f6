"""The stored spheres cover the collision meshes with little excess, and both measures agree with simple geometry."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dualbrain.robots.assets.meshes import Mesh
from dualbrain.robots.collision_model.coverage import (
    SphereSet,
    are_covered,
    distance_outside,
    is_proven_covered,
    measure_excess,
    required_inflation,
    sample_union_surface,
)
from dualbrain.robots.collision_model.polytope import convex_hull, sample_surface
from tests.robots.panda_oracle import PANDA, link_mesh, link_spheres

LINKS = [link.name for link in PANDA.links]
WORST = {"link0": 0.100, "hand": 0.014, "left_finger": 0.013, "right_finger": 0.013}
CUBE = Mesh(
    np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)]),
    np.array(
        [
            [0, 1, 3],
            [0, 3, 2],
            [4, 7, 5],
            [4, 6, 7],
            [0, 5, 1],
            [0, 4, 5],
            [2, 3, 7],
            [2, 7, 6],
            [0, 2, 6],
            [0, 6, 4],
            [1, 5, 7],
            [1, 7, 3],
        ]
    ),
)


@pytest.mark.parametrize("link", LINKS)
def test_the_stored_spheres_are_proven_to_cover_every_point_of_the_mesh(link):
    assert is_proven_covered(link_mesh(link), link_spheres(link))


def test_the_stored_spheres_cover_a_sample_of_the_whole_robot():
    area = {link: link_mesh(link).areas.sum() for link in LINKS}
    rng = np.random.default_rng(5)
    for link in LINKS:
        count = int(20_000 * area[link] / sum(area.values())) + 200
        assert are_covered(sample_surface(link_mesh(link), count, rng), link_spheres(link)).all()


@pytest.mark.slow
def test_the_stored_spheres_cover_a_large_sample():
    rng = np.random.default_rng(6)
    covered = [are_covered(sample_surface(link_mesh(link), 20_000, rng), link_spheres(link)) for link in LINKS]
    assert np.concatenate(covered).mean() >= 0.999


@pytest.mark.parametrize("link", LINKS)
def test_the_excess_is_below_its_bound(link):
    excess = measure_excess(link_mesh(link), link_spheres(link), 1500, np.random.default_rng(7))
    assert excess.worst <= WORST.get(link, 0.027)


def test_the_excess_of_the_finger_tips_is_small_at_the_pads():
    for link, inward in (("left_finger", -1.0), ("right_finger", 1.0)):
        surface = sample_union_surface(link_spheres(link), 20_000, np.random.default_rng(8))
        tip = surface[surface[:, 2] > 0.034]
        assert tip[:, 2].max() - link_mesh(link).vertices[:, 2].max() <= 0.003
        assert np.max(inward * tip[:, 1]) <= 0.004


def test_a_missing_sphere_is_detected():
    for link in ("link3", "hand", "left_finger"):
        spheres = link_spheres(link)
        for i in range(len(spheres.radii)):
            others = SphereSet(np.delete(spheres.centres, i, axis=0), np.delete(spheres.radii, i))
            assert not is_proven_covered(link_mesh(link), others, max_subdivisions=6)


def test_a_cube_needs_a_sphere_of_its_half_diagonal():
    small = SphereSet(np.zeros((1, 3)), np.array([1.5]))
    none = SphereSet(np.zeros((0, 3)), np.zeros(0))
    assert 1.5 + required_inflation(CUBE, none, small) == pytest.approx(np.sqrt(3), abs=3e-5)
    inflated = SphereSet(small.centres, np.array([np.sqrt(3) + 1e-6]))
    excess = measure_excess(CUBE, inflated, 20_000, np.random.default_rng(0))
    assert excess.worst == pytest.approx(np.sqrt(3) - 1, abs=5e-3)
    assert excess.volume_ratio == pytest.approx(np.pi * np.sqrt(3) / 2, rel=0.03)


@given(st.tuples(*[st.floats(-3, 3)] * 3))
def test_distance_outside_a_cube_agrees_with_the_formula(point):
    outside = np.linalg.norm(np.maximum(np.abs(point) - 1, 0))
    assert distance_outside(CUBE, np.array([point]))[0] == pytest.approx(outside, abs=1e-9)


@given(st.tuples(*[st.floats(-0.99, 0.99)] * 3), st.floats(0.01, 3))
def test_a_sphere_extends_its_radius_less_its_depth_beyond_a_convex_solid(centre, radius):
    depth = convex_hull(CUBE).depth(np.array([centre]))[0]
    assert depth == pytest.approx(1 - np.max(np.abs(centre)))
    surface = sample_union_surface(SphereSet(np.array([centre]), np.array([radius])), 4000, np.random.default_rng(1))
    assert distance_outside(CUBE, surface).max() <= max(radius - depth, 0) + 1e-9
