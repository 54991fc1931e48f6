"""The spheres contain the shapes on new points, within the budget; the convex parts contain the solid."""

import numpy as np
import pytest

from dualbrain.robots.assets.mesh_primitives import (
    box,
    capsule,
    concatenate_meshes,
    cylinder,
    ellipsoid,
    thickened_hull_mesh,
)
from dualbrain.robots.assets.meshes import Mesh
from dualbrain.robots.collision_model.convex_decomposition import decompose_convex, mesh_volume
from dualbrain.robots.collision_model.polytope import convex_hull, sample_surface
from dualbrain.robots.collision_model.sphere_budget import QUICK, fit_links
from tests.robots.importer.urdf_builder import transform

ELL = concatenate_meshes(
    [box(np.array([0.2, 0.04, 0.04]), np.eye(4)), box(np.array([0.04, 0.04, 0.2]), transform((0.16, 0, 0.16)))]
)


def is_in_capsule(points, radius, half):
    """Whether the distance to the segment of half length `half` along z is at most `radius`."""
    nearest = np.column_stack([np.zeros((len(points), 2)), np.clip(points[:, 2], -half, half)])
    return np.linalg.norm(points - nearest, axis=1) <= radius


@pytest.mark.parametrize(
    ("shape", "true_volume", "inside"),
    [
        (
            cylinder(0.1, 0.2, np.eye(4)),
            np.pi * 0.01 * 0.4,
            lambda x: (np.hypot(x[:, 0], x[:, 1]) <= 0.1) & (abs(x[:, 2]) <= 0.2),
        ),
        (ellipsoid(np.full(3, 0.1), np.eye(4)), 4 / 3 * np.pi * 1e-3, lambda x: is_in_capsule(x, 0.1, 0.0)),
        (capsule(0.05, 0.1, np.eye(4)), np.pi * 0.0025 * (0.2 + 4 / 3 * 0.05), lambda x: is_in_capsule(x, 0.05, 0.1)),
    ],
    ids=["cylinder", "sphere", "capsule"],
)
def test_the_mesh_of_a_round_shape_contains_it(shape, true_volume, inside):
    points = np.random.default_rng(0).uniform(-0.21, 0.21, (20_000, 3))
    points = points[inside(points)]
    assert convex_hull(shape).depth(points).min() >= -1e-12
    assert 1.0 <= mesh_volume(shape) / true_volume < 1.08


def test_an_l_shape_is_decomposed_into_convex_parts_that_contain_it():
    parts = decompose_convex(ELL)
    assert 2 <= len(parts) <= 4
    assert sum(map(mesh_volume, parts)) < 0.55 * mesh_volume(thickened_hull_mesh(ELL.vertices))
    points = sample_surface(ELL, 5000, np.random.default_rng(3))
    assert np.max([convex_hull(part).depth(points) for part in parts], axis=0).min() > -1e-9


def test_a_flat_sheet_becomes_a_solid():
    sheet = Mesh(np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0.0]]), np.array([[0, 1, 2], [0, 2, 3]]))
    assert mesh_volume(thickened_hull_mesh(sheet.vertices)) == pytest.approx(2e-4, rel=0.01)


def test_every_point_of_every_link_is_covered_within_the_budget():
    shapes = {"ell": [ELL], "rod": [cylinder(0.03, 0.3, transform((0, 0, 0.3)))], "nothing": []}
    fits = fit_links(shapes, {"ell": 1.0, "rod": 2.0, "nothing": 1.0}, 40, QUICK, 0)
    assert sum(len(fit.spheres.radii) for fit in fits.values()) <= 40
    for name, (shape, *_) in ((name, meshes) for name, meshes in shapes.items() if meshes):
        points = sample_surface(shape, 20_000, np.random.default_rng(99))
        spheres = fits[name].spheres
        distances = np.linalg.norm(points[:, None] - spheres.centres, axis=2) - spheres.radii
        enclosed = np.max([convex_hull(part).depth(points) for part in decompose_convex(shape)], axis=0) > 1e-9
        assert np.all((distances.min(axis=1) <= 1e-9) | enclosed)
        assert fits[name].coverage == 1.0
        assert fits[name].worst < 0.08
    assert fits["rod"].worst < fits["ell"].worst


def test_the_excess_is_the_distance_of_the_spheres_from_the_shape():
    """One sphere around a cube: its distance from the cube is r − a at the face centres and 0 at the corners."""
    cube = box(np.full(3, 0.1), np.eye(4))
    fit = fit_links({"cube": [cube]}, {"cube": 1.0}, 1, QUICK, 0)["cube"]
    assert len(fit.spheres.radii) == 1
    assert fit.worst == pytest.approx(fit.spheres.radii[0] - 0.1, abs=0.02)
    assert 0.0 < fit.mean < fit.p95 <= fit.worst
