"""The data file of the Panda is complete and consistent, every bound has a provenance, unknown robots are refused."""

import msgspec
import numpy as np
import pytest

from dualbrain.errors import UnknownNameError
from dualbrain.robots.loader import BUILTIN_ROBOTS, find_model_faults, load_robot
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
