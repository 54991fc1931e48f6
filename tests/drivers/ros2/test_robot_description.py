"""The robot description must be that of the robot model: the imported file, or the same kinematics."""

import hashlib
import json

import msgspec
import pytest

from dualbrain.drivers.ros2.assembly import make_command_filter
from dualbrain.drivers.ros2.problems import Level
from dualbrain.drivers.ros2.robot_description import DescriptionCheck, source_digest
from dualbrain.robots.loader import encode_robot, load_robot
from dualbrain.robots.model import Bound
from tests.drivers.ros2.node_under_test import NAMES, PANDA, TABLE, panda_urdf, parameters, urdf_of


def check_of(robot_model=PANDA, mode="exact", **changes):
    return DescriptionCheck(robot_model, tuple(joint.name for joint in robot_model.joints), mode=mode, **changes)


def with_joint(index, **changes):
    """A Panda with one joint changed."""
    joints = list(PANDA.joints)
    joints[index] = msgspec.structs.replace(joints[index], **changes)
    return msgspec.structs.replace(PANDA, joints=tuple(joints))


def test_the_published_panda_is_the_packaged_one():
    check = check_of()
    assert "No robot description" in check.problem
    check.receive(panda_urdf())
    assert (check.problem, check.base_frame) == ("", "panda_link0")
    assert "kinematics agree" in check.summary


@pytest.mark.parametrize("name", ["panda", "ur5e", "fr3"])
def test_a_description_with_the_same_kinematics_is_accepted_on_any_mount(name):
    robot_model = load_robot(name)
    check = check_of(robot_model)
    check.receive(urdf_of(robot_model, mount=(0.3, 0.2, 0.9)))
    assert (check.problem, check.warning, check.base_frame) == ("", "", "base")


def test_another_robot_is_refused():
    check = check_of()
    check.receive(urdf_of(load_robot("fr3"), names=NAMES))
    assert check.problem == ""  # the same kinematics
    check.receive(urdf_of(load_robot("ur5e")))
    assert "no joint panda_joint1" in check.problem


@pytest.mark.parametrize("index", range(7))
def test_one_displaced_or_turned_joint_is_refused(index):
    x, y, z = PANDA.joints[index].translation
    for changed in (
        with_joint(index, translation=(x + 0.002, y + 0.002, z + 0.002)),
        with_joint(index, quaternion=(0.0, 1.0, 0.0, 0.0)),
    ):
        check = check_of()
        check.receive(urdf_of(changed))
        assert "The robot description is not panda: the axis of panda_joint" in check.problem
        assert "dualbrain robot init" in check.problem


def test_another_base_frame_is_refused():
    check = check_of(base_frame="world")
    check.receive(urdf_of(PANDA, mount=(0.0, 0.0, 0.5)))
    assert "set `base_frame` to base" in check.problem
    check = check_of(base_frame="world")
    check.receive(urdf_of(PANDA))
    assert check.problem == ""


def test_narrower_limits_are_a_warning():
    joint = PANDA.joints[3]
    slower = with_joint(3, velocity=Bound(0.5 * joint.velocity.value, "rad/s", ""))
    check = check_of()
    check.receive(urdf_of(slower))
    assert check.problem == ""
    assert "limits panda_joint4 to" in check.warning
    shorter = with_joint(3, upper=Bound(joint.upper.value - 0.1, "rad", ""))
    check.receive(urdf_of(shorter))
    assert "limits panda_joint4 at" in check.warning
    check.receive(urdf_of(PANDA))
    assert check.warning == ""


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "line 1"),
        ("<robot", "well-formed"),
        ("<mujoco/>", "<mujoco>"),
        ('<!DOCTYPE x [<!ENTITY a "b">]><robot/>', "DOCTYPE"),
        ("<robot/>", "no joint panda_joint1"),
        (urdf_of(PANDA).replace('xyz="0 0 1"', 'xyz="0 0 0"'), "axis of joint"),
        (urdf_of(PANDA).replace('xyz="0 0 1"', 'xyz="0 0 nan"'), "finite"),
        (urdf_of(PANDA).replace('link="world"', 'link="panda_joint7_link"'), "loop"),
        (urdf_of(PANDA).replace('name="panda_joint2"', 'name="panda_joint1"'), "twice"),
    ],
)
def test_an_unusable_description_is_refused(text, words):
    check = check_of()
    check.receive(text)
    assert words in check.problem
    assert "Remedy" in check.problem


def test_only_the_imported_file_is_accepted_of_an_imported_robot():
    text = urdf_of(PANDA)
    check = check_of(digest=hashlib.sha256(text.encode()).hexdigest())
    check.receive(text)
    assert check.problem == ""
    assert "the imported file" in check.summary
    check.receive(text + "\n")
    assert "SHA-256" in check.problem
    assert "kinematics" in check.problem
    check = check_of(mode="kinematics", digest="0" * 64)
    check.receive(text)
    assert check.problem == ""


def test_the_digest_is_that_of_the_robot_folder(tmp_path):
    assert source_digest(tmp_path) == ""
    (tmp_path / "recipe.json").write_text(json.dumps({"description": "a.urdf", "sha256": "ab" * 32}))
    (tmp_path / "body.json").write_bytes(encode_robot(PANDA))
    assert source_digest(tmp_path) == "ab" * 32
    core = make_command_filter(parameters(robot=str(tmp_path), check_description="exact"), (TABLE,))
    core.description.receive(urdf_of(PANDA))
    assert "imported from abababababab" in core.description.problem


@pytest.mark.parametrize("record", [None, "{", '{"sha256": 3}', "{}"])
def test_an_imported_robot_without_a_readable_import_record_is_a_warning(record, tmp_path):
    (tmp_path / "body.json").write_bytes(encode_robot(PANDA))
    if record is not None:
        (tmp_path / "recipe.json").write_text(record)
    core = make_command_filter(parameters(robot=str(tmp_path), check_description="exact"), (TABLE,))
    core.description.receive(urdf_of(PANDA))
    assert core.description.problem == ""
    diagnosis = core.diagnose(0.0)
    assert diagnosis.level is Level.WARN
    assert "recipe.json" in diagnosis.message
    core.description.receive(urdf_of(with_joint(3, velocity=Bound(0.1, "rad/s", ""))))
    assert "limits panda_joint4 to" in core.description.warning
    assert "recipe.json" in core.description.warning
    for robot, mode in ((str(tmp_path), "kinematics"), (str(tmp_path), "none"), ("panda", "exact")):
        core = make_command_filter(parameters(robot=robot, check_description=mode), (TABLE,))
        core.description.receive(urdf_of(PANDA))
        assert core.description.warning == ""


def test_without_a_check_every_description_is_ignored():
    check = check_of(mode="none")
    check.receive("<mujoco/>")
    assert (check.problem, check.summary) == ("", "not checked")


def test_prismatic_joints_are_compared_by_their_direction_and_type():
    robot_model = with_joint(6, kind="prismatic")
    check = check_of(robot_model)
    check.receive(urdf_of(robot_model))
    assert check.problem == ""
    check.receive(urdf_of(PANDA))
    assert "panda_joint7 is revolute in the robot description" in check.problem
