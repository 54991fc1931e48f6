"""Grasp orientations and extents."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dualbrain.core.geometry.rotations import quaternion_to_matrix
from dualbrain.core.geometry.shapes import Bowl, Box, Capsule, Cylinder, Pose, Sphere
from dualbrain.records import SceneObject
from dualbrain.skills.kinematics import object_geometry

yaws = st.floats(-np.pi, np.pi)


def upright_object(shape, yaw=0.0, z=0.1, tilt=0.0):
    quaternion = (
        np.cos(yaw / 2) * np.cos(tilt / 2),
        np.cos(yaw / 2) * np.sin(tilt / 2),
        np.sin(yaw / 2) * np.sin(tilt / 2),
        np.sin(yaw / 2) * np.cos(tilt / 2),
    )
    return SceneObject(name="object", role="object", shape=shape, pose=Pose((0.5, 0.1, z), quaternion))


@pytest.mark.parametrize("approach", object_geometry.APPROACH_LEAN)
@given(yaw=yaws, towards=yaws)
def test_grasp_rotations_are_rotations_with_a_level_finger_axis_and_the_declared_lean(approach, yaw, towards):
    direction = np.array([np.cos(yaw), np.sin(yaw), 0.0])
    outward = np.array([np.cos(towards), np.sin(towards), 0.0])
    for R in object_geometry.grasp_rotations(direction, approach, outward):
        assert np.allclose(R.T @ R, np.eye(3), atol=1e-12)
        assert np.isclose(np.linalg.det(R), 1.0)
        assert np.isclose(abs(R[:, 1] @ direction), 1.0)
        assert np.isclose(np.arccos(np.clip(-R[2, 2], -1, 1)), object_geometry.APPROACH_LEAN[approach], atol=1e-6)


@given(yaw=yaws)
def test_the_first_lean_points_away_from_the_base(yaw):
    direction = np.array([np.cos(yaw), np.sin(yaw), 0.0])
    outward = np.array([1.0, 0.0, 0.0])
    R = object_geometry.grasp_rotations(direction, "side", outward)[0]
    assert R[:, 2] @ outward >= -1e-9


@given(yaw=yaws, tilt=st.floats(0.0, np.pi))
def test_the_height_of_a_box_is_that_of_its_highest_corner(yaw, tilt):
    box = upright_object(Box((0.02, 0.03, 0.05)), yaw, tilt=tilt)
    corners = np.array(np.meshgrid(*[(-1, 1)] * 3)).reshape(3, -1).T * (0.02, 0.03, 0.05)
    heights = (corners @ quaternion_to_matrix(box.pose.quaternion).T)[:, 2] + 0.1
    assert np.isclose(object_geometry.top_height(box), heights.max())
    assert np.isclose(object_geometry.bottom_height(box), heights.min())


@pytest.mark.parametrize(
    ("shape", "top", "wide"),
    [
        (Sphere(0.03), 0.13, 0.06),
        (Cylinder(0.02, 0.04), 0.14, 0.04),
        (Capsule(0.02, 0.04), 0.16, 0.04),
        (Bowl(0.08, 0.05, 0.004), 0.15, 0.16),
    ],
)
def test_upright_extents(shape, top, wide):
    assert np.isclose(object_geometry.top_height(upright_object(shape)), top)
    assert np.isclose(object_geometry.grasp_width(upright_object(shape), "along"), wide)


@given(yaw=yaws)
def test_along_and_across_are_perpendicular_and_level(yaw):
    box = upright_object(Box((0.02, 0.03, 0.05)), yaw)
    along, across = object_geometry.finger_direction(box, "along"), object_geometry.finger_direction(box, "across")
    assert np.isclose(along @ across, 0.0)
    assert along[2] == across[2] == 0.0
    assert np.isclose(np.linalg.norm(along), 1.0)


@given(yaw=yaws, tilt=st.floats(0.0, np.pi))
def test_the_grasp_width_is_that_of_the_corners(yaw, tilt):
    box = upright_object(Box((0.02, 0.03, 0.05)), yaw, tilt=tilt)
    corners = np.array(np.meshgrid(*[(-1, 1)] * 3)).reshape(3, -1).T * (0.02, 0.03, 0.05)
    for axis in ("along", "across"):
        extents = corners @ quaternion_to_matrix(box.pose.quaternion).T @ object_geometry.finger_direction(box, axis)
        assert np.isclose(object_geometry.grasp_width(box, axis), np.ptp(extents))


def test_a_lying_cylinder_is_as_wide_as_it_is_long():
    lying = upright_object(Cylinder(0.02, 0.06), tilt=np.pi / 2)
    assert np.isclose(object_geometry.grasp_width(lying, "along"), 0.04)
    assert np.isclose(object_geometry.levelness(lying, "along"), 1.0)
    assert np.isclose(object_geometry.levelness(lying, "across"), 0.0, atol=1e-9)
