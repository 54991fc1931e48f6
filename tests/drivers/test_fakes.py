"""The fakes refuse the same commands as the vendors' interfaces, and have the names of the vendors' libraries."""

import inspect
import re
import threading
import time

import msgspec
import numpy as np
import pytest

from dualbrain.drivers.conformance.harness import DriverHarness, DriverUnderTest
from dualbrain.drivers.fakes import franka, ur
from dualbrain.drivers.fakes.franka import ERROR_FLAGS, FakeFranka
from dualbrain.drivers.fakes.ur import FakeUr
from dualbrain.drivers.franka import SDK_EXCEPTIONS, FrankaDriver
from dualbrain.drivers.franka_hand import FrankaHand
from dualbrain.drivers.ur import UrDriver
from dualbrain.drivers.vendor_limits import FR3, UR5E
from dualbrain.robots.builtin import fr3 as fr3_definition
from dualbrain.robots.interface import Command
from dualbrain.robots.loader import load_robot
from dualbrain.robots.model import Bound
from dualbrain.safety.cbf.config import FilterConfig
from dualbrain.safety.cbf.filter import SafetyFilter
from tests.drivers import drivers_under_test

ONE = np.eye(7)
TIMEOUT = 20.0
"""Longest time [s] that a test waits for a thread."""


def enabled_franka(sdk=None, robot_model=None):
    """A harness with an enabled Franka driver at zero velocity, and its fake library."""
    robot_model = robot_model or load_robot("fr3")
    sdk = sdk or FakeFranka(robot_model)
    driver = FrankaDriver(sdk, "fake", robot_model)
    trial = DriverHarness(DriverUnderTest(driver, robot_model))
    assert trial.switch_on()
    return trial, sdk


# --- the Franka interface -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("ramp", "flag"),
    [
        ((0.004,), ""),
        ((0.006,), "joint_motion_generator_acceleration_discontinuity"),
        ((0.011,), "joint_motion_generator_velocity_discontinuity"),
        ((0.005, 0.014, 0.02), ""),
        ((0.005, 0.0149, 0.0151), "joint_motion_generator_acceleration_discontinuity"),
    ],
    ids=["within", "jerk", "acceleration", "ramp", "ramp that ends abruptly"],
)
def test_a_command_outside_a_limit_raises_the_reflex_of_that_limit(ramp, flag):
    """From rest, with 10 rad/s² and 5000 rad/s³ at 1 kHz: the acceleration may change by 5 rad/s² per packet."""
    trial, sdk = enabled_franka()
    for value in ramp:
        trial.write(value * ONE[0])
    assert trial.state.drive_enabled is not bool(flag)
    assert getattr(sdk.controller.errors, flag) if flag else not sdk.controller.errors
    assert flag in "".join(trial.driver.faults())


def test_velocity_limits_decrease_towards_the_end_of_a_joint():
    low, high = FR3.velocity_limits(np.array(load_robot("fr3").home))
    assert (high[:3] == 2.62).all()
    lower, upper, allowed = np.array(fr3_definition.POSITION_VELOCITY_LIMITS).T
    assert FR3.velocity_limits(upper)[1] == pytest.approx(allowed, abs=0.02), "the manufacturer's constant limits"
    assert -FR3.velocity_limits(lower)[0] == pytest.approx(allowed, abs=0.02)
    assert (FR3.velocity_limits(FR3.position_range[:, 1])[1] < 0.5).all()
    assert (low < 0).all()


@pytest.mark.parametrize(("silent", "aborted"), [(19, False), (20, True)])
def test_exactly_twenty_missed_packets_in_a_row_end_the_motion(silent, aborted):
    trial, sdk = enabled_franka()
    trial.wait(silent)
    assert sdk.controller.errors.communication_constraints_violation is aborted
    assert trial.state.drive_enabled is not aborted
    if not aborted:
        trial.write(np.zeros(7))
        trial.wait(silent)
        assert trial.state.drive_enabled, "one packet in time resets the count"


def test_a_missed_packet_is_extrapolated_at_constant_acceleration():
    trial, sdk = enabled_franka()
    for k in range(1, 6):
        trial.write(0.004 * k * ONE[1])
    trial.wait(3)
    assert sdk.controller._u[1] == pytest.approx(0.004 * 8)
    trial.write(0.004 * 9 * ONE[1])
    assert trial.state.drive_enabled, "a command that continues the extrapolation has no jerk"


def test_only_recovery_clears_a_reflex_and_a_pressed_user_stop_refuses_it():
    trial, sdk = enabled_franka()
    sdk.controller.collide()
    trial.wait(2)
    assert "joint_reflex" in trial.driver.faults()[0]
    with pytest.raises(franka.CommandException, match="joint_reflex"):
        sdk.controller.start()
    sdk.controller.press_user_stop()
    assert not trial.switch_on()
    assert "user stop" in trial.driver.faults()[0].lower()
    sdk.controller.release_user_stop()
    assert trial.switch_on()
    assert trial.driver.faults() == ()


def test_a_lost_connection_raises_nothing_and_keeps_the_last_state():
    trial, sdk = enabled_franka()
    sdk.unplugged = True
    before = trial.state
    trial.write(np.zeros(7), 5)
    assert not trial.state.drive_enabled
    assert trial.state.sequence == before.sequence
    assert "Timeout" in trial.driver.faults()[0]


def narrowed(robot_model, share=0.98):
    """The robot model with limits a little inside those of the manufacturer, as commissioning requires."""
    joints = tuple(
        msgspec.structs.replace(
            joint,
            **{
                name: Bound(share * getattr(joint, name).value, getattr(joint, name).unit, "test")
                for name in ("velocity", "acceleration", "jerk")
            },
        )
        for joint in robot_model.joints
    )
    return msgspec.structs.replace(robot_model, joints=joints)


def errors_of_filtered_motion(config, seconds=1.2):
    """The errors of the controller after a random nominal control was filtered and sent to the fake arm."""
    trial, sdk = enabled_franka(robot_model=narrowed(load_robot("fr3")))
    safety = SafetyFilter(trial.robot_model, config)
    rng = np.random.default_rng(5)
    nominal = np.zeros(7)
    for k in range(trial.n_periods(seconds)):
        if k % 60 == 0:
            nominal = rng.uniform(-1.0, 1.0, 7)
        if k % 30 == 0:
            safety.observe((), trial.state.stamp)
        result = safety.filter(trial.state, nominal, trial.state.stamp)
        trial.write(result.u)
        if not trial.state.drive_enabled:
            break
    return str(sdk.controller.errors)


def test_the_arm_accepts_filtered_commands_only_with_jerk_limits():
    assert errors_of_filtered_motion(FilterConfig(jerk_limits=True)) == "[]"
    assert "acceleration_discontinuity" in errors_of_filtered_motion(FilterConfig())


def test_the_hand_closes_on_an_object_and_reports_that_it_is_held():
    trial, sdk = enabled_franka()
    sdk.hand.object_width = 0.04
    close = Command(np.zeros(7), 0.0, 20.0)
    for _ in range(20_000):
        trial.driver.write(close)
        trial.wait()
        if trial.state.finger_forces == (20.0, 20.0):
            break
        sdk.controller.missed_in_a_row = 0
    assert trial.state.opening == pytest.approx(0.02)
    assert ("grasp", 0.0, 20.0) in sdk.hand.calls
    trial.driver.close()


def test_an_object_that_the_fingers_already_touch_is_gripped():
    """As after an error of the hand, or a stop: the grasp changes the force, and not the width."""
    sdk = FakeFranka(load_robot("fr3"))
    sdk.hand.object_width = 0.04
    sdk.hand.move(0.04, 0.05)
    hand = FrankaHand(sdk.hand, (franka.NetworkException,))
    hand.set_target(0.0, 20.0)
    deadline = time.monotonic() + TIMEOUT
    while hand.measured != (pytest.approx(0.02), 20.0) and time.monotonic() < deadline:
        time.sleep(1e-3)
    assert hand.measured == (pytest.approx(0.02), 20.0)
    hand.close()


def test_connecting_moves_no_finger():
    robot_model = load_robot("fr3")
    sdk = FakeFranka(robot_model)
    sdk.hand.move(0.04, 0.05)
    driver = FrankaDriver(sdk, "fake", robot_model)
    time.sleep(0.2)
    driver.close()
    assert sdk.hand.calls == [("move", 0.04, 0.05)]
    assert driver.read().opening == pytest.approx(0.02)


def write_until(trial, command, condition):
    """Write `command` in every period until `condition(state)` holds, at most for `TIMEOUT`."""
    end = time.monotonic() + TIMEOUT
    while time.monotonic() < end:
        trial.driver.write(command)
        trial.wait()
        if condition(trial.state):
            return trial.state
        time.sleep(1e-3)  # for the threads of the hand
    raise AssertionError("no state met the condition")


@pytest.mark.parametrize("call", ["grasp", "read_once"])
def test_an_error_of_the_hand_ends_the_motion_and_is_reported(call):
    trial, sdk = enabled_franka()
    works, close = getattr(sdk.hand, call), Command(np.zeros(7), 0.0, 20.0)

    def fail(*_):
        raise franka.NetworkException("libfranka gripper: TCP connection closed")

    sdk.hand.object_width = 0.04
    setattr(sdk.hand, call, fail)
    state = write_until(trial, close, lambda state: not state.drive_enabled)
    assert state.opening is None or call == "grasp", "the fingers may be anywhere"
    assert trial.driver.faults() == ("hand: libfranka gripper: TCP connection closed",)
    setattr(sdk.hand, call, works)
    assert trial.switch_on()
    assert trial.driver.faults() == ()
    state = write_until(trial, close, lambda state: state.finger_forces == (20.0, 20.0))
    assert (state.opening, state.drive_enabled) == (pytest.approx(0.02), True)
    trial.driver.close()


def test_the_opening_is_read_while_the_fingers_move():
    trial, sdk = enabled_franka()
    may_arrive = threading.Event()

    def move_slowly(width, speed):
        del speed
        sdk.hand._width = 0.05
        assert may_arrive.wait(TIMEOUT)
        sdk.hand._width = width
        return True

    sdk.hand.move = move_slowly
    close = Command(np.zeros(7), 0.0, 0.0)
    write_until(trial, close, lambda state: state.opening == pytest.approx(0.025))
    may_arrive.set()
    write_until(trial, close, lambda state: state.opening == 0.0)
    trial.driver.close()


# --- the UR interface ---------------------------------------------------------------------------------------------


def enabled_ur():
    robot_model = load_robot("ur5e")
    sdk = FakeUr(robot_model)
    trial = DriverHarness(DriverUnderTest(UrDriver(sdk, "fake", robot_model), robot_model))
    assert trial.switch_on()
    return trial, sdk.controller


def test_a_watchdog_that_is_not_kicked_ends_the_script():
    trial, controller = enabled_ur()
    trial.swing_joint(0, 0.1, 0.6, stop_fraction=0.5)
    trial.wait(round(0.098 / 0.002))
    assert controller.script_running
    trial.wait(3)
    assert not controller.script_running
    assert "watchdog" in trial.driver.faults()[0]


def test_exceeding_a_joint_speed_is_a_protective_stop_that_can_be_unlocked_after_5_s():
    trial, controller = enabled_ur()
    for k in range(1, 400):
        trial.write(np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.01 * k]))
    assert controller.protective_stopped
    assert trial.driver.faults() == ("protective stop",)
    assert not trial.switch_on()
    assert trial.driver.faults() == ("protective stop: clear it at the pendant",)
    while "Cannot" in controller.unlock_protective_stop():
        assert controller.arm.now - controller._stopped_at < 5.0
        trial.wait()
    assert trial.switch_on()


def test_the_leading_axis_reaches_its_speed_with_the_given_acceleration():
    trial, controller = enabled_ur()
    controller.set_speed([0.2, 0.1, 0.0, 0.0, 0.0, 0.0], 10.0)
    for _ in range(5):
        controller.step()
    assert controller._u[:2] == pytest.approx([0.1, 0.05])
    with pytest.raises(ValueError, match="acceleration"):
        controller.set_speed([0.0] * 6, 41.0)
    assert (UR5E.position_range == 2.0 * np.pi * np.array((-1.0, 1.0))).all()
    assert trial.driver._acceleration == 15.0


def slow_ur(delay=0.1):
    """A driver whose controller takes `delay` [s] to load the script, and the controller."""
    robot_model = load_robot("ur5e")
    sdk = FakeUr(robot_model)
    driver, load = UrDriver(sdk, "fake", robot_model), sdk.controller.load_script
    sdk.controller.load_script = lambda: (time.sleep(delay), load())[1]
    return driver, sdk.controller


@pytest.mark.parametrize("end", ["stop", "close"])
def test_a_stop_while_the_script_is_loaded_keeps_the_drive_off(end):
    driver, controller = slow_ur()
    driver.enable()
    time.sleep(0.02)
    getattr(driver, end)()
    driver._start_thread.join(10.0)
    driver.wait()
    assert not driver.read().drive_enabled
    assert not controller.script_running
    assert driver.faults() == ()


def test_a_drive_that_is_wanted_again_while_the_script_is_loaded_comes_on():
    driver, controller = slow_ur()
    driver.enable()
    driver.stop()
    driver.enable()
    driver._start_thread.join(10.0)
    driver.wait()
    assert driver.read().drive_enabled
    driver.stop()
    assert not controller.script_running


def test_after_an_emergency_stop_the_script_does_not_restart_by_itself():
    trial, controller = enabled_ur()
    controller.press_emergency_stop()
    trial.write(np.zeros(6), 2)
    assert trial.driver.faults() == ("emergency stop",)
    controller.release_emergency_stop()
    trial.write(np.zeros(6), 10)
    assert not trial.state.drive_enabled
    assert trial.switch_on()


def test_a_closed_ur_driver_has_disconnected_both_interfaces():
    trial, controller = enabled_ur()
    assert controller.connections == 2
    trial.driver.close()
    trial.driver.close()
    assert controller.connections == 0
    assert not controller.script_running


@pytest.mark.parametrize("name", ["getTimestamp", "getActualQ", "isEmergencyStopped"])
def test_joint_states_of_a_ur_that_cannot_be_read_end_the_motion_and_raise_nothing(name, monkeypatch):
    trial, controller = enabled_ur()
    before = trial.state

    def fail():
        raise RuntimeError("unable to get state data")

    with monkeypatch.context() as patch:
        patch.setattr(trial.driver._receive, name, fail)
        trial.write(np.zeros(6), 3)
        assert not trial.driver.read().drive_enabled
        assert not controller.script_running
        assert trial.driver.read().sequence >= before.sequence
        assert "cannot be read" in trial.driver.faults()[0]
        assert "unable to get state data" in trial.driver.faults()[0]
        if name == "isEmergencyStopped":
            trial.driver.enable()
            assert "check the connection" in trial.driver.faults()[0]
    assert trial.switch_on()
    assert trial.driver.faults() == ()


# --- the vendors' libraries ---------------------------------------------------------------------------------------


def parameters(function):
    """Names of a function's parameters, from its signature or from the line that pybind11 writes in its docstring."""
    try:
        names = tuple(inspect.signature(function).parameters)
    except ValueError:
        line = function.__doc__.splitlines()[0]
        arguments = re.search(r"\((.*)\)", line).group(1)
        names = tuple(re.findall(r"(\w+): ", re.sub(r"\[[^\]]*\]", "", arguments)))
    return tuple(name for name in names if name != "self")


def test_the_fake_franka_has_the_names_of_pylibfranka():
    real = pytest.importorskip("pylibfranka")
    for fake, name in (
        (franka.Robot, "Robot"),
        (franka.ActiveControlBase, "ActiveControlBase"),
        (franka.FakeHand, "Gripper"),
    ):
        for method, function in vars(fake).items():
            if method.startswith("_") or not callable(function):
                continue
            original = getattr(getattr(real, name), method)
            if "Overloaded" not in original.__doc__ and "*args" not in original.__doc__:
                assert parameters(function) == parameters(original), (name, method)
    assert set(ERROR_FLAGS) <= set(dir(real.Errors))
    assert {mode.name: mode.value for mode in franka.RobotMode}.items() <= {
        name: int(value) for name, value in real.RobotMode.__members__.items()
    }.items()
    for name in SDK_EXCEPTIONS:
        assert issubclass(getattr(real, name), Exception)
        assert hasattr(FakeFranka, name)
    assert list(real.JointVelocities([0.1] * 7).dq) == [0.1] * 7
    with pytest.raises(TypeError):
        real.JointVelocities([0.0] * 6)
    assert {"q", "dq", "time", "robot_mode", "current_errors"} <= set(dir(real.RobotState))
    assert hasattr(real.ControllerMode, "JointImpedance")
    assert hasattr(real.RealtimeConfig, "kEnforce")


def test_the_fake_ur_has_the_names_of_ur_rtde():
    control = pytest.importorskip("rtde_control").RTDEControlInterface
    receive = pytest.importorskip("rtde_receive").RTDEReceiveInterface
    for fake, real in ((ur.Control, control), (ur.Receive, receive)):
        for method, function in vars(fake).items():
            if not method.startswith("_") and callable(function):
                assert parameters(function) == parameters(getattr(real, method)), method
    for factory, real in ((FakeUr.RTDEControlInterface, control), (FakeUr.RTDEReceiveInterface, receive)):
        assert parameters(factory) == parameters(real.__init__)[:2]


@pytest.mark.parametrize(
    "u",
    [np.zeros(5), np.zeros(8), np.zeros((1, 6)), np.zeros(0), np.array(0.1), np.array(["0"] * 6), np.zeros(6, complex)],
    ids=["five", "eight", "a row", "none", "a number", "texts", "complex"],
)
@pytest.mark.parametrize("make", [drivers_under_test.ur, drivers_under_test.franka])
def test_a_command_of_another_shape_ends_the_motion_and_kicks_no_watchdog(make, u):
    trial = DriverHarness(make())
    assert trial.switch_on()
    trial.driver.write(Command(u, 0.04, 0.0))
    assert not trial.driver.read().drive_enabled
    assert "joint speeds" in "".join(trial.driver.faults())
