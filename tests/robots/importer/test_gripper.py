"""The gripper that a description tells: the Panda's beside the figures written by hand, and what is not guessed."""

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
from experiments.robots.zoo_robots import robots_folder
from tests.robots.importer.urdf_builder import joint_xml, limit_policy, link_xml, urdf_xml, write_file

GRIP = {"grip_force_min": StatedLimit(5.0, "test"), "grip_force": StatedLimit(60.0, "test")}
MIRRORED = '<mimic joint="slide0" multiplier="-1"/>'
RANGE = '<limit lower="{}" upper="{}" velocity="0.1" effort="30"/>'


def hand(low=0.0, high=0.04, kind="prismatic", axes=("0 1 0", "0 -1 0"), gap=0.0, mimic="", fingers=2):
    """A turning joint, a palm, and fingers whose pads face each other across y."""
    names, sides = ("left", "right", "third"), (1.0, -1.0, 3.0)
    parts = [
        link_xml("base"),
        link_xml("palm", (0.1, 0.2, 0.04), (0, 0, 0.02)),
        joint_xml("turn", "base", "palm", axis="0 0 1"),
    ]
    for k in range(fingers):
        middle = (0.0, sides[k] * (0.01 + 0.5 * gap), 0.03)
        parts.append(link_xml(names[k], (0.024, 0.02, 0.06), middle))
        follows = mimic if k else ""
        parts.append(
            joint_xml(
                f"slide{k}", "palm", names[k], kind, axes[k % 2], "0 0 0.05", inside=RANGE.format(low, high) + follows
            )
        )
    return urdf_xml(*parts)


def told(folder, text, said=GRIP, **more):
    tree = read_urdf(write_file(folder, text))
    return detect_gripper(tree, find_chain(tree, base="base", tip="palm", **more), said, keep_tool=bool(more))


def test_the_pandas_hand_is_told_as_it_was_written_by_hand():
    tree = read_urdf(robots_folder() / "panda_description/urdf/panda.urdf")
    chain = find_chain(tree)
    found = detect_gripper(tree, chain, GRIP, keep_tool=False)
    assert isinstance(found, DetectedGripper), found
    assert found.gripper.opening.value == panda.GRIPPER.opening.value
    assert found.gripper.force.value == 60.0, "the site's word is narrower than the file's 100 N"
    assert found.gripper.pad_below_tool == pytest.approx(panda.GRIPPER.pad_below_tool, abs=1e-3)
    assert found.gripper.finger_thickness == pytest.approx(panda.GRIPPER.finger_thickness, abs=0.002)
    own = next(rider.poses[0] for rider in chain.segments if rider.link == "panda_hand")
    local = np.linalg.inv(own) @ found.tool
    assert np.allclose(local[:3, 3], panda.TOOL.translation, atol=1.5e-3)
    assert abs(local[1, 1]) == pytest.approx(1.0)
    assert local[2, 2] == pytest.approx(1.0)


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
def test_two_fingers_that_slide_are_told_however_they_are_counted(tmp_path, shape):
    found = told(tmp_path, hand(**shape))
    assert isinstance(found, DetectedGripper), found
    assert found.gripper.opening.value == pytest.approx(0.04)
    assert found.gripper.finger_thickness == pytest.approx(0.02 + 0.5 * shape.get("gap", 0.0))
    assert found.gripper.force.value == 30.0
    assert np.allclose(found.tool[:3, 3], (0.0, 0.0, 0.05 + 0.06 - TOOL_TO_TIP_DISTANCE))
    assert np.allclose(np.abs(found.tool[:3, 1:3]), [[0, 0], [1, 0], [0, 1]])


@pytest.mark.parametrize(
    ("shape", "why"),
    [
        ({"kind": "revolute"}, "not two that slide"),
        ({"fingers": 1}, "1 joints of fingers"),
        ({"fingers": 3}, "3 joints of fingers"),
        ({"fingers": 0}, "no fingers that move"),
        ({"gap": 0.03}, "30 mm apart"),
        ({"axes": ("0 1 0", "1 0 0")}, "do not slide apart"),
        ({"axes": ("0 0 1", "0 0 -1")}, "apart at the shut end"),
    ],
)
def test_what_is_no_such_gripper_is_not_guessed(tmp_path, shape, why):
    assert why in told(tmp_path, hand(**shape))


def test_the_force_that_nobody_stated_is_asked_for(tmp_path):
    assert "--grip" in told(tmp_path, hand(), {})
    assert "above the greatest" in told(tmp_path, hand(), {"grip_force_min": StatedLimit(31.0, "test")})
    assert isinstance(told(tmp_path, hand(), {"grip_force_min": StatedLimit(5.0, "test")}), DetectedGripper)


def test_a_tool_frame_that_was_named_stays_or_is_said_not_to_fit(tmp_path):
    found = told(tmp_path, hand(), tool="palm")
    assert np.allclose(found.tool, np.eye(4))
    assert found.gripper.pad_below_tool == pytest.approx(0.11)
    turned = hand().replace(
        "</robot>",
        link_xml("aside") + joint_xml("weld", "palm", "aside", "fixed", rpy="1.57 0 0", inside="") + "</robot>",
    )
    assert "tool frame's z is not the approach" in told(tmp_path, turned, tool="aside")


def test_the_body_offers_skills_that_grip_once_its_hand_is_told(tmp_path):
    tree, plain = read_urdf(write_file(tmp_path, hand())), limit_policy()
    wish = ImportOptions(quick=True, sphere_budget=30, base="base", tip="palm")
    gripping = build_arm(tree, LimitPolicy(plain.all_joints, {}, {**plain.robot, **GRIP}), wish).robot_model
    bare = build_arm(tree, plain, wish).robot_model
    assert "grasp" in skill_registry(gripping).by_name
    assert gripping.gripper.force_min.value == 5.0
    assert "grasp" not in skill_registry(bare).by_name
    assert any("gripper" in line and "--grip" in line for line in missing_information(bare, None))
    assert not any("gripper" in line for line in missing_information(gripping, None))
