"""The data file of the Panda is complete and consistent, every bound has a provenance, unknown robots are refused."""

import msgspec
import numpy as np
import pytest

from dualbrain.errors import UnknownNameError
from dualbrain.robots.loader import BUILTIN_ROBOTS, find_home_faults, find_model_faults, load_robot
from dualbrain.robots.model import RobotModel, TrackingErrorModel

PANDA = load_robot("panda")


def test_decoding_inverts_encoding():
    assert msgspec.json.decode(msgspec.json.encode(PANDA), type=RobotModel) == PANDA


def test_an_unknown_robot_is_refused_with_the_closest_name():
    with pytest.raises(UnknownNameError, match="Closest: 'panda'") as caught:
        load_robot("pamda")
    assert caught.value.known == tuple(sorted(BUILTIN_ROBOTS))


def test_every_bound_is_positive_in_si_units_with_a_provenance():
    for joint in PANDA.joints:
        assert joint.lower.value < joint.upper.value
        assert (joint.lower.unit, joint.velocity.unit, joint.acceleration.unit) == ("rad", "rad/s", "rad/s^2")
        assert joint.velocity.value > 0
        assert joint.acceleration.value > 0
        for bound in (joint.lower, joint.upper, joint.velocity):
            assert joint.name in bound.provenance
        assert "Franka FCI" in joint.acceleration.provenance
    for bound in (PANDA.gripper.opening, PANDA.gripper.force, PANDA.gripper.force_min, PANDA.tool_speed):
        assert bound.provenance


@pytest.mark.parametrize(
    ("entry", "value"),
    [
        ("position_error", (0.01,) * 6),
        ("position_error", (0.01,) * 6 + (-0.01,)),
        ("position_error", -0.01),
        ("lag", -0.001),
        ("rate", -3.0),
    ],
    ids=["count", "negative for one joint", "negative", "lag", "rate"],
)
def test_a_tracking_model_that_fits_no_robot_is_refused(entry, value):
    wrong = msgspec.structs.replace(PANDA.tracking, **{entry: value})
    faults = [where for where, _, _ in find_model_faults(msgspec.structs.replace(PANDA, tracking=wrong))]
    assert faults == [f"{entry} of the drive {PANDA.tracking.drive!r}"]
    others = msgspec.structs.replace(PANDA, other_drives=(wrong,))
    assert len(list(find_model_faults(others))) == 1


NO_UNIT_SLIDE = msgspec.structs.replace(PANDA.links[-1], slide=(0.0, 2.0, 0.0))
UNKNOWN_GROUP = msgspec.structs.replace(PANDA.links[-1], group="gripper")
FAR_LINK = msgspec.structs.replace(PANDA.links[-1], translation=(0.0, 1e9, 0.0))
FAR_JOINT = msgspec.structs.replace(PANDA.joints[-1], translation=(1e9, 0.0, 0.0))


@pytest.mark.parametrize(
    ("changes", "entry"),
    [
        ({"base_lag": -0.01}, "base_lag"),
        ({"base_lag": float("nan")}, "base_lag"),
        ({"links": (*PANDA.links[:-1], NO_UNIT_SLIDE)}, f"slide of link {NO_UNIT_SLIDE.name!r}"),
        ({"links": (*PANDA.links[:-1], UNKNOWN_GROUP)}, f"group of link {UNKNOWN_GROUP.name!r}"),
        ({"links": (*PANDA.links[:-1], FAR_LINK)}, f"translation of link {FAR_LINK.name!r}"),
        ({"joints": (*PANDA.joints[:-1], FAR_JOINT)}, f"translation of joint {FAR_JOINT.name!r}"),
        ({"tool": msgspec.structs.replace(PANDA.tool, translation=(0.0, 0.0, -1e9))}, "translation of the tool"),
        ({"spheres": ()}, "spheres"),
        (
            {"spheres": (*PANDA.spheres, msgspec.structs.replace(PANDA.spheres[-1], centre=(1e9, 0.0, 0.0)))},
            f"sphere of {PANDA.spheres[-1].link!r}",
        ),
    ],
)
def test_a_model_with_an_entry_that_no_robot_has_is_refused(changes, entry):
    assert [where for where, _, _ in find_model_faults(msgspec.structs.replace(PANDA, **changes))] == [entry]


def test_a_home_outside_the_range_of_a_joint_is_refused():
    outside = msgspec.structs.replace(PANDA, home=(0.0, -0.3, 0.0, 0.5, 0.0, 2.0, float("nan")))
    entries = [where for where, _, _ in find_home_faults(outside)]
    assert entries == ["home", "home of joint 'panda_joint4'", "home of joint 'panda_joint7'"]
    mobile = load_robot("mobile_panda")
    far = msgspec.structs.replace(mobile, home=(500.0, -500.0, 9.0, *mobile.home[3:]))
    assert not list(find_home_faults(far)), "the pose of a base has no range"
    stretched = msgspec.structs.replace(mobile, home=(*mobile.home[:-1], 99.0))
    assert [where for where, _, _ in find_home_faults(stretched)] == [f"home of joint {mobile.joints[-1].name!r}"]


@pytest.mark.parametrize(
    ("name", "value"),
    [("opening", -0.01), ("opening", float("nan")), ("force", -1.0), ("force_min", -1.0), ("force_min", 90.0)],
)
def test_a_gripper_with_impossible_numbers_is_refused(name, value):
    bound = msgspec.structs.replace(getattr(PANDA.gripper, name), value=value)
    wrong = msgspec.structs.replace(PANDA, gripper=msgspec.structs.replace(PANDA.gripper, **{name: bound}))
    assert f"{name} of the gripper" in [where for where, _, _ in find_model_faults(wrong)]


@pytest.mark.parametrize(("name", "value"), [("finger_thickness", -0.01), ("pad_below_tool", float("inf"))])
def test_fingers_with_impossible_sizes_are_refused(name, value):
    wrong = msgspec.structs.replace(PANDA, gripper=msgspec.structs.replace(PANDA.gripper, **{name: value}))
    assert [where for where, _, _ in find_model_faults(wrong)] == [f"{name} of the gripper"]


@pytest.mark.parametrize("name", BUILTIN_ROBOTS)
def test_the_packaged_robots_have_no_wrong_entry(name):
    robot_model = load_robot(name)
    assert not [*find_model_faults(robot_model), *find_home_faults(robot_model)]


def test_the_automatic_gain_is_the_smallest_ratio_of_acceleration_to_speed():
    assert pytest.approx(7.5 / 2.175) == PANDA.alpha


def test_home_is_well_within_the_limits():
    q = np.array(PANDA.home)
    lower = np.array([joint.lower.value for joint in PANDA.joints])
    upper = np.array([joint.upper.value for joint in PANDA.joints])
    assert np.all(np.minimum(q - lower, upper - q) > 0.5)


def test_spheres_and_tool_refer_to_links_and_quaternions_are_unit():
    names = {link.name for link in PANDA.links}
    assert {sphere.link for sphere in PANDA.spheres} == names
    assert PANDA.tool.link in names
    assert {link.group for link in PANDA.links} == {"arm", "hand", "fingers"}
    for frame in (*PANDA.joints, *PANDA.links, PANDA.tool):
        assert np.linalg.norm(frame.quaternion) == pytest.approx(1.0, abs=1e-12)


def test_fingers_slide_apart_along_the_finger_axis():
    slides = {link.name: link.slide for link in PANDA.links if link.group == "fingers"}
    assert slides == {"left_finger": (0.0, 1.0, 0.0), "right_finger": (0.0, -1.0, 0.0)}


def test_the_number_of_spheres_is_within_the_budget_and_the_hand_has_many():
    count = {link.name: sum(sphere.link == link.name for sphere in PANDA.spheres) for link in PANDA.links}
    assert sum(count.values()) <= 104
    assert count["hand"] >= 30
    assert count["left_finger"] == count["right_finger"] >= 8


def test_every_identified_drive_names_the_command_that_identified_it():
    for tracking in (PANDA.tracking, *PANDA.other_drives):
        assert f"dualbrain robot identify --robot panda --drive {tracking.drive}" in tracking.provenance
        assert tracking.rate == pytest.approx(PANDA.alpha)
        assert 0.0 <= tracking.lag < 0.01
        assert 0.0 < tracking.position_error < 0.01


def test_the_drive_can_be_changed_and_changed_back():
    other = PANDA.with_drive("velocity")
    assert other.tracking == PANDA.other_drives[0]
    assert other.with_drive(PANDA.tracking.drive) == PANDA
    with pytest.raises(UnknownNameError, match="velocity"):
        PANDA.with_drive("velocities")


def test_a_tracking_model_is_replaced_or_added():
    replacement = TrackingErrorModel(
        lag=0.001, position_error=0.002, rate=3.0, provenance="test", drive=PANDA.tracking.drive
    )
    assert PANDA.with_tracking(replacement).tracking == replacement
    assert PANDA.with_tracking(replacement).other_drives == PANDA.other_drives
    added = TrackingErrorModel(lag=0.001, position_error=0.002, rate=3.0, provenance="test", drive="hydraulic")
    assert PANDA.with_tracking(added).with_drive("hydraulic").tracking == added
    assert PANDA.with_tracking(added).tracking == PANDA.tracking
