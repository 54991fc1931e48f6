"""Names, signs and offsets of servos: the same position in any order, and a reason for every unusable action."""

import numpy as np
import pytest

from dualbrain.errors import ConfigurationError, UnknownNameError
from dualbrain.safety.integration.servo_bus.servo_map import ServoCalibration, ServoMap
from tests.safety.integration.servo_bus.ideal_servos import KEYS, NAMES, SO101, action

MAP = ServoMap.of(SO101, KEYS)
Q = np.array([0.1, -0.2, 0.3, -0.4, 0.5])


def test_degrees_become_radians_in_any_order_and_back():
    values = action(Q)
    shuffled = {key: values[key] for key in reversed(list(values))}
    np.testing.assert_allclose(MAP.positions(shuffled), Q, atol=1e-12)
    assert MAP.values(Q) == {key: pytest.approx(values[key]) for key in KEYS[:5]}
    assert MAP.write(Q + 0.1, values)["gripper.pos"] == 30.0
    assert MAP.passed == ("gripper.pos",)


def test_sign_offset_and_the_name_of_a_servo_are_those_of_the_calibration():
    calibration = {"elbow_flex": ServoCalibration(key="motor_3", sign=-1, offset=5.0)}
    found = ServoMap.of(SO101, [*(key for key in KEYS if "elbow" not in key), "motor_3.pos"], calibration=calibration)
    values = {**action(Q), "motor_3.pos": 5.0 - np.degrees(Q[2])}
    np.testing.assert_allclose(found.positions(values), Q, atol=1e-12)
    assert found.values(Q)["motor_3.pos"] == pytest.approx(values["motor_3.pos"])


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda a: {key: a[key] for key in a if key != "elbow_flex.pos"}, "lacks elbow_flex.pos"),
        (lambda a: {**a, "elbow.pos": 0.0}, "names elbow.pos; the robot has shoulder_pan.pos"),
        (lambda a: {**a, "wrist_roll.pos": float("nan")}, "wrist_roll.pos in the action is no finite number"),
        (lambda a: {**a, "gripper.pos": float("inf")}, "gripper.pos in the action"),
        (lambda a: {**a, "wrist_roll.pos": "1.0"}, "wrist_roll.pos in the action"),
        (lambda a: {**a, "wrist_roll.pos": True}, "wrist_roll.pos in the action"),
        (lambda a: {**a, "wrist_roll.pos": [1.0, 2.0]}, "wrist_roll.pos in the action"),
        (lambda a: list(a.values()), "no mapping of servo names but list"),
        (lambda a: {}, "lacks shoulder_pan.pos, shoulder_lift.pos"),
        (lambda a: None, "no mapping"),
    ],
)
def test_an_unusable_action_has_a_reason(change, reason):
    assert reason in MAP.find_problem(change(action(Q)))
    assert reason in MAP.read(change(action(Q)), 5, None)


def test_numbers_of_numpy_are_numbers():
    assert not MAP.find_problem({key: np.float32(1.0) for key in KEYS})
    assert not MAP.find_problem({key: np.array(1.0) for key in KEYS})
    assert np.isnan(MAP.positions({key: None for key in KEYS})).all()


def test_a_map_that_does_not_fit_is_refused():
    with pytest.raises(ConfigurationError, match=r"so101 need the servos .*; the robot has a.pos, b.pos"):
        ServoMap.of(SO101, ["a.pos", "b.pos"])
    with pytest.raises(ConfigurationError, match="so101"):
        ServoMap.of(SO101, KEYS, calibration={"elbow_flex": ServoCalibration(key="wrist_flex")})
    with pytest.raises(UnknownNameError, match="elbow_fleks"):
        ServoMap.of(SO101, KEYS, calibration={"elbow_fleks": ServoCalibration(sign=-1)})
    with pytest.raises(ConfigurationError, match="sign"):
        ServoCalibration(sign=0)
    with pytest.raises(ConfigurationError, match="offset"):
        ServoCalibration(offset=float("nan"))
    with pytest.raises(ConfigurationError, match="servos"):
        MAP.check(6)


def test_a_reading_outside_of_the_range_of_a_joint_is_a_problem():
    assert not MAP.find_range_problem(np.array([joint.upper.value for joint in SO101.joints]))
    out = np.zeros(5)
    out[NAMES.index("wrist_flex")] = 1.8
    assert "wrist_flex.pos reads 103.1° after calibration; wrist_flex has the range -95° to 95°" in (
        MAP.find_range_problem(out)
    )
    assert MAP.find_range_problem(np.full(5, np.nan))
