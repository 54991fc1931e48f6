"""Every bound has its provenance, the narrower word holds, and what nobody stated is asked for, never assumed."""

import pytest

from dualbrain.errors import InvalidSetup, UnknownName
from dualbrain.robots.importer.build_arm import Wish, build_arm
from dualbrain.robots.importer.required_limits import Given, MissingLimits, Policy
from dualbrain.robots.importer.urdf import read_urdf
from tests.robots.importer.urdf_builder import arm_with_everything, joint, link, policy, urdf, written

QUICK = Wish(quick=True, spheres=30)


@pytest.fixture(scope="module")
def tree(tmp_path_factory):
    return read_urdf(written(tmp_path_factory.mktemp("arm"), arm_with_everything()))


def test_a_bound_tells_file_line_and_entry_or_who_said_it(tree):
    lift, shoulder, elbow = build_arm(tree, policy(velocity=1.0), QUICK).body.joints
    assert shoulder.lower.provenance == "robot.urdf:12: shoulder limit lower"
    assert shoulder.velocity.value == 1.0
    assert shoulder.velocity.provenance == "test; wider: 1.5 of robot.urdf:12: shoulder limit velocity"
    assert shoulder.acceleration.provenance == "test"
    assert lift.velocity.value == 0.2
    assert "wider: 1 of test" in lift.velocity.provenance
    assert (lift.velocity.unit, shoulder.velocity.unit, lift.acceleration.unit) == ("m/s", "rad/s", "m/s^2")
    assert "continuous, no limit" in elbow.lower.provenance


def test_everything_missing_is_asked_for_at_once(tree):
    with pytest.raises(MissingLimits) as caught:
        build_arm(tree, Policy(), QUICK)
    assert {(one.what, one.side) for one in caught.value.missing} == {
        *((name, "acceleration") for name in ("lift", "shoulder", "elbow")), ("robot", "period"),
        ("robot", "tool_speed"),
    }  # fmt: skip
    assert "--acceleration VALUE" in str(caught.value)


def test_a_range_that_the_description_leaves_out_is_asked_for(tmp_path):
    bare = '<limit effort="3" velocity="0"/>'
    text = urdf(link("a"), link("b"), joint("j", "a", "b", inside=bare))
    with pytest.raises(MissingLimits) as caught:
        build_arm(read_urdf(written(tmp_path, text)), policy(), QUICK)
    assert [one.side for one in caught.value.missing] == ["lower", "upper", "velocity"]


@pytest.mark.parametrize(
    ("said", "match"),
    [({"velocity": -1.0}, "above 0"), ({"lower": 3.0}, "lower below upper"), ({"acceleration": 0.0}, "above 0")],
)
def test_a_bound_that_leaves_nothing_is_refused(tree, said, match):
    whole = policy()
    joints = {"shoulder": {side: Given(value, "site") for side, value in said.items()}}
    with pytest.raises(InvalidSetup, match=match):
        build_arm(tree, Policy(whole.every, joints, whole.robot), QUICK)


def test_a_policy_for_a_joint_that_is_not_there_is_refused(tree):
    whole = policy()
    with pytest.raises(UnknownName, match="Closest: 'shoulder'"):
        build_arm(tree, Policy(whole.every, {"sholder": {}}, whole.robot), QUICK)
