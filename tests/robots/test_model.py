"""The Panda's data file: complete, consistent, every bound with its source, unknown bodies refused."""

import msgspec
import numpy as np
import pytest

from dualbrain.errors import UnknownNameError
from dualbrain.robots.loader import BUILTIN_ROBOTS, load_robot
from dualbrain.robots.model import RobotModel, TrackingErrorModel

PANDA = load_robot("panda")


def test_the_data_survives_json_unchanged():
    assert msgspec.json.decode(msgspec.json.encode(PANDA), type=RobotModel) == PANDA


def test_an_unknown_body_is_refused_with_the_closest_name():
    with pytest.raises(UnknownNameError, match="Closest: 'panda'") as caught:
        load_robot("pamda")
    assert caught.value.known == tuple(sorted(BUILTIN_ROBOTS))


def test_every_bound_is_positive_si_and_says_where_it_comes_from():
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


def test_the_automatic_gain_is_the_smallest_ratio_of_acceleration_to_speed():
    assert pytest.approx(7.5 / 2.175) == PANDA.alpha


def test_home_lies_well_inside_the_limits():
    q = np.array(PANDA.home)
    lower = np.array([joint.lower.value for joint in PANDA.joints])
    upper = np.array([joint.upper.value for joint in PANDA.joints])
    assert np.all(np.minimum(q - lower, upper - q) > 0.5)


def test_every_name_used_is_a_link_and_quaternions_are_unit():
    names = {link.name for link in PANDA.links}
    assert {sphere.link for sphere in PANDA.spheres} == names
    assert PANDA.tool.link in names
    assert {link.group for link in PANDA.links} == {"arm", "hand", "fingers"}
    for part in (*PANDA.joints, *PANDA.links, PANDA.tool):
        assert np.linalg.norm(part.quaternion) == pytest.approx(1.0, abs=1e-12)


def test_fingers_slide_apart_along_the_finger_axis():
    slides = {link.name: link.slide for link in PANDA.links if link.group == "fingers"}
    assert slides == {"left_finger": (0.0, 1.0, 0.0), "right_finger": (0.0, -1.0, 0.0)}


def test_the_budget_of_spheres_is_kept_and_the_hand_is_covered_finely():
    count = {link.name: sum(sphere.link == link.name for sphere in PANDA.spheres) for link in PANDA.links}
    assert sum(count.values()) <= 104
    assert count["hand"] >= 30
    assert count["left_finger"] == count["right_finger"] >= 8


def test_every_identified_drive_says_how():
    for tracking in (PANDA.tracking, *PANDA.other_drives):
        assert f"dualbrain robot identify --robot panda --drive {tracking.drive}" in tracking.provenance
        assert tracking.rate == pytest.approx(PANDA.alpha)
        assert 0.0 <= tracking.lag < 0.01
        assert 0.0 < tracking.position_error < 0.01


def test_a_body_can_be_driven_otherwise_and_back():
    other = PANDA.with_drive("velocity")
    assert other.tracking == PANDA.other_drives[0]
    assert other.with_drive(PANDA.tracking.drive) == PANDA
    with pytest.raises(UnknownNameError, match="velocity"):
        PANDA.with_drive("velocities")


def test_an_entry_is_renewed_or_added():
    renewed = TrackingErrorModel(
        lag=0.001, position_error=0.002, rate=3.0, provenance="test", drive=PANDA.tracking.drive
    )
    assert PANDA.with_tracking(renewed).tracking == renewed
    assert PANDA.with_tracking(renewed).other_drives == PANDA.other_drives
    added = TrackingErrorModel(lag=0.001, position_error=0.002, rate=3.0, provenance="test", drive="hydraulic")
    assert PANDA.with_tracking(added).with_drive("hydraulic").tracking == added
    assert PANDA.with_tracking(added).tracking == PANDA.tracking
