"""The detected gripper of the Panda agrees with its hand-written definition; any other gripper gives a reason."""

import numpy as np
import pytest

from dualbrain.robots.builtin import panda
from dualbrain.robots.importer.build_arm import ImportOptions, build_arm
from dualbrain.robots.importer.gripper import TOOL_TO_TIP_DISTANCE, DetectedGripper, detect_gripper
from dualbrain.robots.importer.kinematic_chain import find_chain
from dualbrain.robots.importer.output.markdown import missing_information
from dualbrain.robots.importer.required_limits import LimitPolicy, StatedLimit
from dualbrain.robots.importer.urdf import read_urdf
from dualbrain.skills.registry import skill_registry
from experiments.robots.zoo.zoo_robots import robots_folder
from tests.robots.importer.urdf_builder import joint_xml, limit_policy, link_xml, urdf_xml, write_file

GRIP = {"grip_force_min": StatedLimit(5.0, "test"), "grip_force": StatedLimit(60.0, "test")}
MIRRORED = '<mimic joint="slide0" multiplier="-1"/>'
RANGE = '<limit lower="{}" upper="{}" velocity="0.1" effort="30"/>'


def hand(low=0.0, high=0.04, kind="prismatic", axes=("0 1 0", "0 -1 0"), gap=0.0, mimic="", fingers=2):
    """A revolute joint, a palm, and fingers whose pads face each other along y."""
    names, sides = ("left", "right", "third"), (1.0, -1.0, 3.0)
    parts = [
        link_xml("base"),
        link_xml("palm", (0.1, 0.2, 0.04), (0, 0, 0.02)),
        joint_xml("turn", "base", "palm", axis="0 0 1"),
    ]
    for k in range(fingers):
        middle = (0.0, sides[k] * (0.01 + 0.5 * gap), 0.03)
        parts.append(link_xml(names[k], (0.024, 0.02, 0.06), middle))
        limits = RANGE.format(low, high) + (mimic if k else "")
        parts.append(joint_xml(f"slide{k}", "palm", names[k], kind, axes[k % 2], "0 0 0.05", inside=limits))
    return urdf_xml(*parts)


def detect(folder, text, stated=GRIP, **options):
    tree = read_urdf(write_file(folder, text))
    chain = find_chain(tree, base="base", tip="palm", **options)
    return detect_gripper(tree, chain, stated, keep_tool=bool(options))


def test_the_detected_gripper_of_the_panda_agrees_with_its_definition():
    tree = read_urdf(robots_folder() / "panda_description/urdf/panda.urdf")
    chain = find_chain(tree)
    detected = detect_gripper(tree, chain, GRIP, keep_tool=False)
    assert isinstance(detected, DetectedGripper), detected
    assert detected.gripper.opening.value == panda.GRIPPER.opening.value
    assert detected.gripper.force.value == 60.0, "the stated force is narrower than the 100 N of the file"
    assert detected.gripper.pad_below_tool == pytest.approx(panda.GRIPPER.pad_below_tool, abs=1e-3)
    assert detected.gripper.finger_thickness == pytest.approx(panda.GRIPPER.finger_thickness, abs=0.002)
    hand_pose = next(segment.poses[0] for segment in chain.segments if segment.link == "panda_hand")
    tool = np.linalg.inv(hand_pose) @ detected.tool
    assert np.allclose(tool[:3, 3], panda.TOOL.translation, atol=1.5e-3)
    assert abs(tool[1, 1]) == pytest.approx(1.0)
    assert tool[2, 2] == pytest.approx(1.0)


@pytest.mark.parametrize(
    "shape",
    [
        {},
        {"mimic": '<mimic joint="slide0"/>'},
        {"axes": ("0 1 0", "0 1 0"), "mimic": MIRRORED},
        {"axes": ("0 -1 0", "0 1 0"), "low": -0.04, "high": 0.0},
        {"gap": 0.006},
    ],
)
def test_two_prismatic_fingers_are_detected_for_every_sign_convention(tmp_path, shape):
    detected = detect(tmp_path, hand(**shape))
    assert isinstance(detected, DetectedGripper), detected
    assert detected.gripper.opening.value == pytest.approx(0.04)
    assert detected.gripper.finger_thickness == pytest.approx(0.02 + 0.5 * shape.get("gap", 0.0))
    assert detected.gripper.force.value == 30.0
    assert np.allclose(detected.tool[:3, 3], (0.0, 0.0, 0.05 + 0.06 - TOOL_TO_TIP_DISTANCE))
    assert np.allclose(np.abs(detected.tool[:3, 1:3]), [[0, 0], [1, 0], [0, 1]])


@pytest.mark.parametrize(
    ("shape", "reason"),
    [
        ({"kind": "revolute"}, "2 finger joints (revolute) instead of two prismatic ones"),
        ({"fingers": 1}, "1 finger joints"),
        ({"fingers": 3}, "3 finger joints"),
        ({"fingers": 0}, "no moving fingers"),
        ({"gap": 0.03}, "30 mm apart"),
        ({"axes": ("0 1 0", "1 0 0")}, "do not slide apart"),
        ({"axes": ("0 0 1", "0 0 -1")}, "apart at the closed end"),
    ],
)
def test_another_gripper_is_not_guessed(tmp_path, shape, reason):
    assert reason in detect(tmp_path, hand(**shape))


def test_the_minimum_force_must_be_stated(tmp_path):
    assert "--grip" in detect(tmp_path, hand(), {})
    assert "is above the maximum" in detect(tmp_path, hand(), {"grip_force_min": StatedLimit(31.0, "test")})
    assert isinstance(detect(tmp_path, hand(), {"grip_force_min": StatedLimit(5.0, "test")}), DetectedGripper)


def test_a_given_tool_frame_is_kept_or_reported_as_unsuitable(tmp_path):
    detected = detect(tmp_path, hand(), tool="palm")
    assert np.allclose(detected.tool, np.eye(4))
    assert detected.gripper.pad_below_tool == pytest.approx(0.11)
    rotated = hand().replace(
        "</robot>",
        link_xml("rotated") + joint_xml("weld", "palm", "rotated", "fixed", rpy="1.57 0 0", inside="") + "</robot>",
    )
    assert "z of the tool frame is not the approach" in detect(tmp_path, rotated, tool="rotated")


def test_the_skills_that_grasp_are_offered_once_the_gripper_is_known(tmp_path):
    tree, policy = read_urdf(write_file(tmp_path, hand())), limit_policy()
    options = ImportOptions(quick=True, sphere_budget=30, base="base", tip="palm")
    with_gripper = build_arm(tree, LimitPolicy(policy.all_joints, {}, {**policy.robot, **GRIP}), options).robot_model
    without_gripper = build_arm(tree, policy, options).robot_model
    assert "grasp" in skill_registry(with_gripper).by_name
    assert with_gripper.gripper.force_min.value == 5.0
    assert "grasp" not in skill_registry(without_gripper).by_name
    assert any("gripper" in line and "--grip" in line for line in missing_information(without_gripper, None))
    assert not any("gripper" in line for line in missing_information(with_gripper, None))
