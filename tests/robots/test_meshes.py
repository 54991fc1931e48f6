"""Meshes are found in the installed data package and read; a missing package or file is reported with its fix."""

from importlib import metadata

import numpy as np
import pytest

from dualbrain.errors import ConfigurationError, MissingDependencyError, UnknownNameError
from dualbrain.robots.assets import meshes
from dualbrain.robots.assets.meshes import Mesh, collision_mesh, description_folder, mesh_path
from dualbrain.robots.collision_model.polytope import convex_hull, sample_surface


def test_the_description_is_found_with_its_urdf():
    assert (description_folder("panda") / "urdf" / "panda.urdf").is_file()
    assert mesh_path("panda", "visual", "hand").suffix == ".dae"


def test_a_missing_package_is_reported_with_the_command_that_installs_it(monkeypatch):
    def raise_not_found(name):
        raise metadata.PackageNotFoundError(name)

    monkeypatch.setattr(meshes.metadata, "files", raise_not_found)
    with pytest.raises(MissingDependencyError, match="pip install --no-deps example-robot-data"):
        description_folder("panda")


def test_a_package_without_the_robot_is_a_missing_dependency(monkeypatch):
    monkeypatch.setattr(meshes.metadata, "files", lambda _: [])
    with pytest.raises(MissingDependencyError, match="description of 'panda'"):
        description_folder("panda")


def test_unknown_robots_and_meshes_are_refused():
    with pytest.raises(UnknownNameError):
        description_folder("pandas")
    with pytest.raises(MissingDependencyError):
        mesh_path("panda", "collision", "link9")


def test_the_finger_mesh_ends_where_the_pad_ends():
    finger = collision_mesh("panda", "finger")
    assert finger.vertices[:, 2].max() == pytest.approx(0.0538, abs=2e-4)
    assert finger.areas.sum() == pytest.approx(0.0050, rel=0.02)


def test_surface_points_are_on_the_hull_of_a_convex_mesh():
    mesh = collision_mesh("panda", "hand")
    depth = convex_hull(mesh).depth(sample_surface(mesh, 2000, np.random.default_rng(0)))
    assert np.all(np.abs(depth) < 1e-3)


def test_a_mesh_that_is_not_convex_is_refused():
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [0.1, 0.1, 0.1]], dtype=float)
    dented = Mesh(corners, np.array([[0, 1, 2], [0, 1, 3], [0, 2, 3], [1, 2, 4], [1, 3, 4], [2, 3, 4]]))
    with pytest.raises(ConfigurationError, match="convex"):
        convex_hull(dented)
