"""Every bound has its provenance, the narrower bound holds, and a missing bound is requested, never assumed."""

from importlib import metadata
from pathlib import Path

import pytest

from dualbrain.errors import ConfigurationError, UnknownNameError, UsageError
from dualbrain.robots.importer.build_arm import ImportOptions, build_arm
from dualbrain.robots.importer.build_mobile_base import build_base
from dualbrain.robots.importer.required_limits import (
    LimitPolicy,
    MissingLimit,
    MissingLimitsError,
    StatedLimit,
    joint_bounds,
    make_limit_policy,
)
from dualbrain.robots.importer.urdf import read_urdf
from dualbrain.robots.model import Bound
from dualbrain.robots.site_config import read_site
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


def test_the_provenance_of_a_bound_has_file_line_and_entry_or_the_stated_source(tree):
    lift, shoulder, elbow = build_arm(tree, limit_policy(velocity=1.0), QUICK).robot_model.joints
    assert shoulder.lower.provenance == "robot.urdf:12: shoulder limit lower"
    assert shoulder.velocity.value == 1.0
    assert shoulder.velocity.provenance == "test; wider: 1.5 of robot.urdf:12: shoulder limit velocity"
    assert shoulder.acceleration.provenance == "test"
    assert lift.velocity.value == 0.2
    assert "wider: 1 of test" in lift.velocity.provenance
    assert (lift.velocity.unit, shoulder.velocity.unit, lift.acceleration.unit) == ("m/s", "rad/s", "m/s^2")
    assert "continuous, no limit" in elbow.lower.provenance


def test_all_missing_limits_are_reported_at_once(tree):
    with pytest.raises(MissingLimitsError) as caught:
        build_arm(tree, LimitPolicy(), QUICK)
    assert {(one.owner, one.limit) for one in caught.value.missing} == {
        *((name, "acceleration") for name in ("lift", "shoulder", "elbow")),
        ("robot", "period"),
        ("robot", "tool_speed"),
    }
    assert "--acceleration VALUE" in str(caught.value)


DRAKE_LIMIT = '<limit lower="-1" upper="1" velocity="2" drake:acceleration="2.5" drake:jerk="40"/>'


@pytest.mark.parametrize("declaration", ["", ' xmlns:drake="http://drake.mit.edu"'], ids=["undeclared", "declared"])
def test_acceleration_and_jerk_are_read_from_the_attributes_of_drake(tmp_path, declaration):
    text = urdf_xml(link_xml("a"), link_xml("b"), joint_xml("j", "a", "b", inside=DRAKE_LIMIT))
    tree = read_urdf(write_file(tmp_path, text.replace("<robot", f"<robot{declaration}")))
    policy = limit_policy()
    (joint,) = build_arm(tree, LimitPolicy({}, {}, policy.robot), QUICK).robot_model.joints
    assert (joint.acceleration.value, joint.acceleration.unit) == (2.5, "rad/s^2")
    assert joint.acceleration.provenance == "robot.urdf:5: j limit acceleration"
    assert joint.jerk is not None
    assert (joint.jerk.value, joint.jerk.provenance) == (40.0, "robot.urdf:5: j limit jerk")


@pytest.mark.parametrize(("stated", "value", "first"), [(1.0, 1.0, "test"), (9.0, 2.5, "robot.urdf:5")])
def test_a_stated_acceleration_only_narrows_that_of_the_description(tmp_path, stated, value, first):
    text = urdf_xml(link_xml("a"), link_xml("b"), joint_xml("j", "a", "b", inside=DRAKE_LIMIT))
    tree = read_urdf(write_file(tmp_path, text))
    (joint,) = build_arm(tree, limit_policy(acceleration=stated), QUICK).robot_model.joints
    assert joint.acceleration.value == value
    assert joint.acceleration.provenance.startswith(first)


def test_a_site_file_narrows_the_acceleration_of_the_description(tmp_path):
    text = urdf_xml(link_xml("a"), link_xml("b"), joint_xml("j", "a", "b", inside=DRAKE_LIMIT))
    site = read_site(write_file(tmp_path, "[joint.j]\nacceleration = 1.5\n", "site.toml"))
    policy = make_limit_policy(site, {"period": 0.002, "tool_speed": 0.25})
    (joint,) = build_arm(read_urdf(write_file(tmp_path, text)), policy, QUICK).robot_model.joints
    assert joint.acceleration.value == 1.5
    assert "site.toml:2" in joint.acceleration.provenance
    assert "wider: 2.5 of robot.urdf:5: j limit acceleration" in joint.acceleration.provenance


WIDE_SITE = """
[robot]
tool_speed = 0.1
[limits]
acceleration = 1.0
velocity = 3.0
[joint.j]
acceleration = 1.5
velocity = 1.2
"""


def test_of_two_stated_limits_the_narrower_one_holds(tmp_path):
    text = urdf_xml(link_xml("a"), link_xml("b"), joint_xml("j", "a", "b", inside=DRAKE_LIMIT))
    options = {"acceleration": 2.0, "velocity": 0.5, "period": 0.002, "tool_speed": 0.25}
    policy = make_limit_policy(read_site(write_file(tmp_path, WIDE_SITE, "site.toml")), options)
    model = build_arm(read_urdf(write_file(tmp_path, text)), policy, QUICK).robot_model
    (joint,) = model.joints
    assert (joint.acceleration.value, joint.velocity.value, model.tool_speed.value) == (1.0, 0.5, 0.1)
    assert joint.acceleration.provenance.startswith("site policy (site.toml:5); wider: ")
    assert joint.velocity.provenance.startswith("site policy (--velocity); wider: ")
    assert model.tool_speed.provenance == "site policy (site.toml:3); wider: 0.25 of site policy (--tool-speed)"


@pytest.mark.parametrize("value", [0.0, -1.0, float("nan"), float("inf")])
def test_an_option_that_is_no_limit_is_refused(value):
    with pytest.raises(UsageError, match=r"--velocity.*above 0"):
        make_limit_policy(None, {"velocity": value})


def test_a_control_period_that_option_and_site_file_state_differently_is_refused(tmp_path):
    site = read_site(write_file(tmp_path, "[robot]\nperiod = 0.002\n", "site.toml"))
    assert make_limit_policy(site, {"period": 0.002}).robot["period"].value == 0.002
    with pytest.raises(UsageError, match=r"--period: got 0\.004, allowed: 0\.002 s, as site\.toml:2 states"):
        make_limit_policy(site, {"period": 0.004})


@pytest.mark.parametrize("name", ["turn", "turn_acceleration"])
def test_a_turn_limit_is_refused_for_an_arm(tree, name):
    policy = limit_policy()
    robot = {**policy.robot, name: StatedLimit(1.0, "site policy (lab.toml:3)")}
    with pytest.raises(ConfigurationError, match=rf"{name} \(site policy \(lab\.toml:3\)\).*no base"):
        build_arm(tree, LimitPolicy(policy.all_joints, policy.by_joint, robot), QUICK)


def test_a_jerk_limit_is_refused_for_a_base(tree):
    with pytest.raises(ConfigurationError, match=r"jerk \(site\).*no jerk limit"):
        build_base(tree, LimitPolicy({"jerk": StatedLimit(1.0, "site")}), QUICK, None)


@pytest.mark.parametrize("text", ["fast", "inf", "nan"])
def test_an_acceleration_that_is_no_finite_number_is_refused(tmp_path, text):
    limit = DRAKE_LIMIT.replace("2.5", text)
    file = write_file(tmp_path, urdf_xml(link_xml("a"), link_xml("b"), joint_xml("j", "a", "b", inside=limit)))
    with pytest.raises(ConfigurationError, match=r"robot\.urdf:5.*finite number"):
        read_urdf(file)


def test_the_accelerations_of_the_ur5e_come_from_its_urdf():
    """The file of airo-models uses the prefix `drake` without declaring it."""
    file = Path(str(metadata.distribution("airo-models").locate_file("airo_models/arms/ur5e/ur5e.urdf")))
    moving = [joint for joint in read_urdf(file).joints if joint.kind == "revolute"]
    assert [joint.acceleration for joint in moving] == 6 * [2.5]
    missing: list[MissingLimit] = []
    bounds = [joint_bounds(joint, LimitPolicy(), missing) for joint in moving]
    assert not missing
    assert bounds[0]["acceleration"] == Bound(2.5, "rad/s^2", "ur5e.urdf:161: shoulder_pan_joint limit acceleration")


def soft_limited_arm(folder, controller, limit='<limit lower="-2" upper="2" velocity="1.5" effort="9"/>'):
    joint = joint_xml("j", "a", "b", inside=f"\n{limit}\n<safety_controller {controller}/>\n")
    return read_urdf(write_file(folder, urdf_xml(link_xml("a"), link_xml("b"), joint)))


def test_the_soft_limits_of_a_safety_controller_narrow_the_range(tmp_path):
    tree = soft_limited_arm(tmp_path, 'soft_lower_limit="-1.5" soft_upper_limit="2.5" k_velocity="9"')
    (joint,) = build_arm(tree, limit_policy(), QUICK).robot_model.joints
    soft = "robot.urdf:7: j safety_controller soft_lower_limit"
    assert joint.lower == Bound(-1.5, "rad", f"{soft}; wider: -2 of robot.urdf:5: j limit lower")
    assert joint.upper == Bound(2.0, "rad", "robot.urdf:5: j limit upper")


@pytest.mark.parametrize(
    ("controller", "ends"),
    [
        ('k_velocity="9"', (-2.0, 2.0)),
        ('soft_lower_limit="0" soft_upper_limit="0.0" k_velocity="9"', (-2.0, 2.0)),
        ('soft_upper_limit="1" k_velocity="9"', (-2.0, 1.0)),
        ('soft_lower_limit="-2" soft_upper_limit="2" k_velocity="9"', (-2.0, 2.0)),
    ],
)
def test_soft_limits_that_are_not_stated_are_no_limits(tmp_path, controller, ends):
    (joint,) = soft_limited_arm(tmp_path, controller).joints
    bounds = joint_bounds(joint, limit_policy(), [])
    assert (bounds["lower"].value, bounds["upper"].value) == ends
    assert "wider: 2 of" not in bounds["lower"].provenance


def test_soft_limits_outside_the_range_of_the_joint_are_refused(tmp_path):
    (joint,) = soft_limited_arm(tmp_path, 'soft_lower_limit="3" soft_upper_limit="4" k_velocity="9"').joints
    with pytest.raises(ConfigurationError, match=r"robot\.urdf:7: j safety_controller.*lower below upper"):
        joint_bounds(joint, limit_policy(), [])


def test_a_soft_limit_that_is_not_finite_is_refused(tmp_path):
    with pytest.raises(ConfigurationError, match="finite"):
        soft_limited_arm(tmp_path, 'soft_lower_limit="nan" soft_upper_limit="1" k_velocity="9"')


def test_an_omitted_range_is_a_missing_limit(tmp_path):
    bare = '<limit effort="3" velocity="0"/>'
    text = urdf_xml(link_xml("a"), link_xml("b"), joint_xml("j", "a", "b", inside=bare))
    with pytest.raises(MissingLimitsError) as caught:
        build_arm(read_urdf(write_file(tmp_path, text)), limit_policy(), QUICK)
    assert [one.limit for one in caught.value.missing] == ["lower", "upper", "velocity"]


@pytest.mark.parametrize(
    ("stated", "match"),
    [({"velocity": -1.0}, "above 0"), ({"lower": 3.0}, "lower below upper"), ({"acceleration": 0.0}, "above 0")],
)
def test_an_empty_range_or_a_limit_of_zero_is_refused(tree, stated, match):
    policy = limit_policy()
    joints = {"shoulder": {name: StatedLimit(value, "site") for name, value in stated.items()}}
    with pytest.raises(ConfigurationError, match=match):
        build_arm(tree, LimitPolicy(policy.all_joints, joints, policy.robot), QUICK)


@pytest.mark.parametrize(("joint", "lock"), [("grip", {}), ("lift", {"lift": 0.2}), ("weld", {})])
def test_a_limit_of_a_joint_outside_the_chain_is_refused(tree, joint, lock):
    policy = limit_policy()
    limits = LimitPolicy(policy.all_joints, {joint: {"velocity": StatedLimit(0.1, "lab.toml:4")}}, policy.robot)
    options = ImportOptions(quick=True, sphere_budget=30, lock=lock)
    with pytest.raises(ConfigurationError, match=rf"velocity of '{joint}' \(lab\.toml:4\).*does not drive"):
        build_arm(tree, limits, options)


def test_a_policy_for_an_unknown_joint_is_refused(tree):
    policy = limit_policy()
    with pytest.raises(UnknownNameError, match="Closest: 'shoulder'"):
        build_arm(tree, LimitPolicy(policy.all_joints, {"sholder": {}}, policy.robot), QUICK)
