"""Every bound has its provenance, the narrower word holds, and what nobody stated is asked for, never assumed."""

import pytest

from dualbrain.errors import ConfigurationError, UnknownNameError
from dualbrain.robots.importer.build_arm import ImportOptions, build_arm
from dualbrain.robots.importer.required_limits import LimitPolicy, MissingLimitsError, StatedLimit
from dualbrain.robots.importer.urdf import read_urdf
from tests.robots.importer.urdf_builder import (
    full_featured_arm,
    joint_xml,
    limit_policy,
    link_xml,
    urdf_xml,
    write_file,
)

QUICK = ImportOptions(quick=True, sphere_budget=30)


@pytest.fixture(scope="module")
def tree(tmp_path_factory):
    return read_urdf(write_file(tmp_path_factory.mktemp("arm"), full_featured_arm()))


def test_a_bound_tells_file_line_and_entry_or_who_said_it(tree):
    lift, shoulder, elbow = build_arm(tree, limit_policy(velocity=1.0), QUICK).robot_model.joints
    assert shoulder.lower.provenance == "robot.urdf:12: shoulder limit lower"
    assert shoulder.velocity.value == 1.0
    assert shoulder.velocity.provenance == "test; wider: 1.5 of robot.urdf:12: shoulder limit velocity"
    assert shoulder.acceleration.provenance == "test"
    assert lift.velocity.value == 0.2
    assert "wider: 1 of test" in lift.velocity.provenance
    assert (lift.velocity.unit, shoulder.velocity.unit, lift.acceleration.unit) == ("m/s", "rad/s", "m/s^2")
    assert "continuous, no limit" in elbow.lower.provenance


def test_everything_missing_is_asked_for_at_once(tree):
    with pytest.raises(MissingLimitsError) as caught:
        build_arm(tree, LimitPolicy(), QUICK)
    assert {(one.owner, one.limit) for one in caught.value.missing} == {
        *((name, "acceleration") for name in ("lift", "shoulder", "elbow")),
        ("robot", "period"),
        ("robot", "tool_speed"),
    }
    assert "--acceleration VALUE" in str(caught.value)


def test_a_range_that_the_description_leaves_out_is_asked_for(tmp_path):
    bare = '<limit effort="3" velocity="0"/>'
    text = urdf_xml(link_xml("a"), link_xml("b"), joint_xml("j", "a", "b", inside=bare))
    with pytest.raises(MissingLimitsError) as caught:
        build_arm(read_urdf(write_file(tmp_path, text)), limit_policy(), QUICK)
    assert [one.limit for one in caught.value.missing] == ["lower", "upper", "velocity"]


@pytest.mark.parametrize(
    ("said", "match"),
    [({"velocity": -1.0}, "above 0"), ({"lower": 3.0}, "lower below upper"), ({"acceleration": 0.0}, "above 0")],
)
def test_a_bound_that_leaves_nothing_is_refused(tree, said, match):
    whole = limit_policy()
    joints = {"shoulder": {side: StatedLimit(value, "site") for side, value in said.items()}}
    with pytest.raises(ConfigurationError, match=match):
        build_arm(tree, LimitPolicy(whole.all_joints, joints, whole.robot), QUICK)


def test_a_policy_for_a_joint_that_is_not_there_is_refused(tree):
    whole = limit_policy()
    with pytest.raises(UnknownNameError, match="Closest: 'shoulder'"):
        build_arm(tree, LimitPolicy(whole.all_joints, {"sholder": {}}, whole.robot), QUICK)
