"""The model of the UR5e agrees with the URDF it comes from, and its spheres cover the meshes."""

import xml.etree.ElementTree as ET
from functools import lru_cache
from importlib import metadata

import msgspec
import numpy as np
import pytest

from dualbrain.robots.builtin import ur5e
from dualbrain.robots.collision_model.coverage import SphereSet, is_proven_covered
from dualbrain.robots.collision_model.self_collision import chain_frames, random_configurations
from dualbrain.robots.loader import load_robot
from tests.robots.panda_oracle import axis_rotation, roll_pitch_yaw

UR5E, LEAN = load_robot("ur5e"), load_robot("ur5e_lean")
NAMES = (
    "base_link_inertia",
    "shoulder_link",
    "upper_arm_link",
    "forearm_link",
    "wrist_1_link",
    "wrist_2_link",
    "wrist_3_link",
)


@lru_cache
def urdf():
    """The root element; the file uses the prefix `drake:` without declaring it."""
    path = metadata.distribution("airo-models").locate_file("airo_models/arms/ur5e/ur5e.urdf")
    return ET.fromstring(path.read_text().replace("drake:", "drake_"))


def numbers(text):
    return np.array(list(map(float, text.split())))


def urdf_pose(link, q):
    """Pose (4, 4) of a link in the root, by a walk through the URDF from the link to the root."""
    values, pose = dict(zip((joint.name for joint in UR5E.joints), q, strict=True)), np.eye(4)
    while (joint := next((j for j in urdf().iter("joint") if _child(j) == link), None)) is not None:
        origin, step = joint.find("origin"), np.eye(4)
        step[:3, :3], step[:3, 3] = roll_pitch_yaw(*numbers(origin.get("rpy"))), numbers(origin.get("xyz"))
        if joint.get("name") in values:
            turn = np.eye(4)
            turn[:3, :3] = axis_rotation(numbers(joint.find("axis").get("xyz")), values[joint.get("name")])
            step = step @ turn
        pose, link = step @ pose, joint.find("parent").get("link")
    return pose


def _child(joint):
    child = joint.find("child")
    return None if child is None else child.get("link")


@pytest.mark.parametrize("seed", range(8))
def test_the_chain_is_the_urdf_chain(seed):
    q = random_configurations(UR5E.joints, 1, np.random.default_rng(seed))[0]
    turns, origins = chain_frames(UR5E.joints, q[None])
    for frame, link in enumerate(NAMES):
        if frame:  # x of the base frame points forward (REP 103); the first joint contains the half turn
            pose = urdf_pose(link, q)
            assert np.allclose(turns[0, frame], pose[:3, :3], atol=1e-8)
            assert np.allclose(origins[0, frame], pose[:3, 3], atol=1e-8)


@pytest.mark.parametrize("joint", UR5E.joints, ids=lambda joint: joint.name)
def test_limits_are_those_of_the_urdf(joint):
    limit = next(j for j in urdf().iter("joint") if j.get("name") == joint.name).find("limit")
    for key in ("lower", "upper", "velocity"):
        assert getattr(joint, key).value == pytest.approx(float(limit.get(key)), abs=2e-5)
    assert "no limit" in joint.acceleration.provenance


def test_the_tool_points_down_at_home():
    turns, origins = chain_frames(UR5E.joints, np.array([UR5E.home]))
    assert np.allclose(turns[0, -1], np.diag([1.0, -1.0, -1.0]), atol=1e-3)
    tip = origins[0, -1] + turns[0, -1] @ np.array(UR5E.tool.translation)
    assert np.allclose(tip, [0.42, 0.0, 0.45], atol=1e-3)


@pytest.mark.parametrize("link", ur5e.LINK_COVERS)
@pytest.mark.parametrize("robot", [UR5E, LEAN], ids=lambda robot: robot.name)
def test_the_stored_spheres_are_verified_to_cover_every_part(robot, link):
    stored = [sphere for sphere in robot.spheres if sphere.link == link]
    spheres = SphereSet(np.array([sphere.centre for sphere in stored]), np.array([sphere.radius for sphere in stored]))
    for spec in ur5e.LINK_COVERS[link]:
        assert is_proven_covered(ur5e.part_mesh(spec.mesh), spheres)
        assert not is_proven_covered(
            ur5e.part_mesh(spec.mesh), SphereSet(spheres.centres, 0.9 * spheres.radii), max_subdivisions=6
        )


@pytest.mark.parametrize("part", ["finger", "knuckle"])
def test_the_right_side_of_the_hand_is_the_left_side_rotated_by_180_degrees(part):
    left, right = (
        np.array([s.centre for s in UR5E.spheres if s.link == f"{side}_{part}"]) for side in ("left", "right")
    )
    assert np.array_equal(right, left * (-1.0, -1.0, 1.0))


def test_the_lean_robot_differs_in_name_and_spheres_only():
    assert msgspec.structs.replace(LEAN, name=UR5E.name, spheres=UR5E.spheres, self_pairs=UR5E.self_pairs) == UR5E
    assert LEAN.self_pairs.kept == UR5E.self_pairs.kept
    for link, parts in ur5e.LEAN_LINK_COVERS.items():
        assert sum(part.n_spheres for part in parts) == sum(sphere.link == link for sphere in LEAN.spheres)
    assert len(LEAN.spheres) == 57
