"""The fakes refuse what the makers' interfaces refuse, and have the names of the makers' libraries."""

import inspect
import re

import msgspec
import numpy as np
import pytest

from dualbrain.drivers.conformance.harness import DriverHarness, DriverUnderTest
from dualbrain.drivers.fakes import franka, ur
from dualbrain.drivers.fakes.franka import ERROR_FLAGS, FakeFranka
from dualbrain.drivers.fakes.ur import FakeUr
from dualbrain.drivers.franka import SDK_EXCEPTIONS, FrankaDriver
from dualbrain.drivers.ur import UrDriver
from dualbrain.drivers.vendor_limits import FR3, UR5E
from dualbrain.robots.builtin import fr3 as fr3_facts
from dualbrain.robots.interface import Command
from dualbrain.robots.loader import load_robot
from dualbrain.robots.model import Bound
from dualbrain.safety.cbf.config import FilterConfig
from dualbrain.safety.cbf.filter import SafetyFilter

ONE = np.eye(7)


def at_work(sdk=None, robot_model=None):
    """A Franka driver under way at zero velocity, and its controller."""
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
    ids=["within", "jerk", "acceleration", "ramp", "ramp broken off"],
)
def test_a_command_outside_of_a_limit_is_a_reflex_with_its_own_flag(ramp, flag):
    """From rest, with 10 rad/s² and 5000 rad/s³ at 1 kHz: steps of 5 mm rad/s in acceleration are the most."""
    trial, sdk = at_work()
    for value in ramp:
        trial.write(value * ONE[0])
    assert trial.state.drive_enabled is not bool(flag)
    assert getattr(sdk.controller.errors, flag) if flag else not sdk.controller.errors
    assert flag in "".join(trial.driver.faults())


def test_velocity_limits_shrink_toward_the_end_of_a_joint():
    low, high = FR3.velocity_limits(np.array(load_robot("fr3").home))
    assert (high[:3] == 2.62).all()
    ends = np.array([bounds[1] for bounds in fr3_facts.POSITION_VELOCITY_LIMITS])
    starts = np.array([bounds[0] for bounds in fr3_facts.POSITION_VELOCITY_LIMITS])
    allowed = np.array([bounds[2] for bounds in fr3_facts.POSITION_VELOCITY_LIMITS])
    assert FR3.velocity_limits(ends)[1] == pytest.approx(allowed, abs=0.02), "the maker's box of constant velocities"
    assert -FR3.velocity_limits(starts)[0] == pytest.approx(allowed, abs=0.02)
    assert (FR3.velocity_limits(FR3.position_range[:, 1])[1] < 0.5).all()
    assert (low < 0).all()


@pytest.mark.parametrize(("silent", "aborted"), [(19, False), (20, True)])
def test_twenty_packets_missed_in_a_row_and_not_one_fewer_end_the_motion(silent, aborted):
    trial, sdk = at_work()
    trial.wait(silent)
    assert sdk.controller.errors.communication_constraints_violation is aborted
    assert trial.state.drive_enabled is not aborted
    if not aborted:
        trial.write(np.zeros(7))
        trial.wait(silent)
        assert trial.state.drive_enabled, "one packet in time, and the count begins anew"


def test_a_missed_packet_is_filled_in_at_constant_acceleration():
    trial, sdk = at_work()
    for k in range(1, 6):
        trial.write(0.004 * k * ONE[1])
    trial.wait(3)
    assert sdk.controller._u[1] == pytest.approx(0.004 * 8)
    trial.write(0.004 * 9 * ONE[1])
    assert trial.state.drive_enabled, "whoever goes on as extrapolated is not jerked"


def test_a_reflex_is_left_by_recovery_only_and_a_pressed_user_stop_refuses_it():
    trial, sdk = at_work()
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


def test_a_cable_that_is_pulled_out_raises_nothing_and_leaves_the_state_old():
    trial, sdk = at_work()
    sdk.unplugged = True
    before = trial.state
    trial.write(np.zeros(7), 5)
    assert not trial.state.drive_enabled
    assert trial.state.sequence == before.sequence
    assert "Timeout" in trial.driver.faults()[0]


def inside(body, share=0.98):
    """The body with every limit a little inside the maker's, as commissioning demands."""
    joints = tuple(
        msgspec.structs.replace(
            joint,
            **{
                side: Bound(share * getattr(joint, side).value, getattr(joint, side).unit, "test")
                for side in ("velocity", "acceleration", "jerk")
            },
        )
        for joint in body.joints
    )
    return msgspec.structs.replace(body, joints=joints)


def fly(config, seconds=1.2):
    """The filter between a wild wish and the fake arm; what the controller said."""
    trial, sdk = at_work(robot_model=inside(load_robot("fr3")))
    safety = SafetyFilter(trial.robot_model, config)
    rng = np.random.default_rng(5)
    wish = np.zeros(7)
    for k in range(trial.n_periods(seconds)):
        if k % 60 == 0:
            wish = rng.uniform(-1.0, 1.0, 7)
        if k % 30 == 0:
            safety.observe((), trial.state.stamp)
        result = safety.filter(trial.state, wish, trial.state.stamp)
        trial.write(result.u)
        if not trial.state.drive_enabled:
            break
    return str(sdk.controller.errors)


def test_the_arm_takes_what_the_filter_lets_through_and_only_with_jerk_limits_in_it():
    assert fly(FilterConfig(jerk_limits=True)) == "[]"
    assert "acceleration_discontinuity" in fly(FilterConfig())


def test_the_hand_closes_on_what_is_there_and_says_whether_it_holds_it():
    trial, sdk = at_work()
    sdk.hand.object_width = 0.04
    closed = Command(np.zeros(7), 0.0, 20.0)
    for _ in range(20_000):
        trial.driver.write(closed)
        trial.wait()
        if trial.state.finger_forces == (20.0, 20.0):
            break
        sdk.controller.missed_in_a_row = 0
    assert trial.state.opening == pytest.approx(0.02)
    assert ("grasp", 0.0, 20.0) in sdk.hand.calls
    trial.driver.close()


# --- the UR interface ---------------------------------------------------------------------------------------------


def ur_at_work():
    robot_model = load_robot("ur5e")
    sdk = FakeUr(robot_model)
    trial = DriverHarness(DriverUnderTest(UrDriver(sdk, "fake", robot_model), robot_model))
    assert trial.switch_on()
    return trial, sdk.controller


def test_a_watchdog_that_is_not_kicked_ends_the_script():
    trial, controller = ur_at_work()
    trial.swing_joint(0, 0.1, 0.6, stop_fraction=0.5)
    trial.wait(round(0.098 / 0.002))
    assert controller.script_running
    trial.wait(3)
    assert not controller.script_running
    assert "watchdog" in trial.driver.faults()[0]


def test_a_joint_beyond_its_speed_is_a_protective_stop_that_only_a_person_unlocks_after_5_s():
    trial, controller = ur_at_work()
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


def test_a_speed_is_reached_by_the_leading_axis_acceleration():
    trial, controller = ur_at_work()
    controller.set_speed([0.2, 0.1, 0.0, 0.0, 0.0, 0.0], 10.0)
    for _ in range(5):
        controller.step()
    assert controller._u[:2] == pytest.approx([0.1, 0.05])
    with pytest.raises(ValueError, match="acceleration"):
        controller.set_speed([0.0] * 6, 41.0)
    assert (UR5E.position_range == 2.0 * np.pi * np.array((-1.0, 1.0))).all()
    assert trial.driver._acceleration == 15.0


def test_after_an_emergency_stop_the_script_does_not_come_back_by_itself():
    trial, controller = ur_at_work()
    controller.press_emergency_stop()
    trial.write(np.zeros(6), 2)
    assert trial.driver.faults() == ("emergency stop",)
    controller.release_emergency_stop()
    trial.write(np.zeros(6), 10)
    assert not trial.state.drive_enabled
    assert trial.switch_on()


# --- the makers' own libraries ------------------------------------------------------------------------------------


def parameters(function):
    """Names of a function's parameters, from its signature or from the line that pybind11 writes into its doc."""
    try:
        names = tuple(inspect.signature(function).parameters)
    except ValueError:
        line = function.__doc__.splitlines()[0]
        inside = re.search(r"\((.*)\)", line).group(1)
        names = tuple(re.findall(r"(\w+): ", re.sub(r"\[[^\]]*\]", "", inside)))
    return tuple(name for name in names if name != "self")


def test_the_fake_franka_has_the_names_of_the_makers_library():
    real = pytest.importorskip("pylibfranka")
    for fake, name in (
        (franka.Robot, "Robot"),
        (franka.ActiveControlBase, "ActiveControlBase"),
        (franka.FakeHand, "Gripper"),
    ):
        for method, function in vars(fake).items():
            if method.startswith("_") or not callable(function):
                continue
            theirs = getattr(getattr(real, name), method)
            if "Overloaded" not in theirs.__doc__ and "*args" not in theirs.__doc__:
                assert parameters(function) == parameters(theirs), (name, method)
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
    for maker, real in ((FakeUr.RTDEControlInterface, control), (FakeUr.RTDEReceiveInterface, receive)):
        assert parameters(maker) == parameters(real.__init__)[:2]
