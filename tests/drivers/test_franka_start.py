"""The Franka driver at the start of a motion, and on a kernel without PREEMPT_RT."""

import msgspec
import numpy as np
import pytest

from dualbrain.drivers.catalogue import DRIVER_KINDS, find_driver_kind
from dualbrain.drivers.fakes.franka import FakeFranka, RobotMode
from dualbrain.drivers.franka import FOLLOWING_STATES, MAX_START_STATES, FrankaDriver
from dualbrain.errors import ConfigurationError
from dualbrain.robots.interface import Command
from dualbrain.robots.loader import load_robot
from dualbrain.safety.cbf.filter import FilterConfig, SafetyFilter

FR3 = load_robot("fr3")
STEP = 4e-3
"""A first command that an arm at rest accepts [rad/s], with a jerk of 4,000 rad/s³."""


class SlowFranka(FakeFranka):
    """An arm that discards the commands of its first states, and refuses a motion whose first commands are not zero."""

    def __init__(self, deaf_states):
        super().__init__(FR3)
        self.sent, command, begin = [], self.controller.command, self.controller._begin
        self.remaining = deaf_states

        def receive(u):
            self.sent.append(u.copy())
            if self.remaining > 0:
                self.remaining -= 1
                if np.any(u != 0.0):
                    self.controller._reflex("joint_motion_generator_acceleration_discontinuity")
                return
            command(u)

        def restart():
            begin()
            self.remaining = deaf_states

        self.controller.command, self.controller._begin = receive, restart


def command(speed):
    return Command(np.full(7, speed), 0.0, 0.0)


@pytest.mark.parametrize("deaf_states", [0, 3, 15])
def test_the_first_wish_after_enable_is_accepted(deaf_states):
    """The driver sends zeros until the arm confirms commands, so the first wish continues a velocity of zero."""
    sdk = SlowFranka(deaf_states)
    driver = FrankaDriver(sdk, "fake", FR3, hand=False)
    driver.enable()
    assert driver.read().drive_enabled
    assert len(sdk.sent) >= deaf_states + FOLLOWING_STATES
    assert not np.any(sdk.sent)
    for _ in range(5):
        driver.wait()
        driver.write(command(STEP))
    driver.wait()
    assert driver.faults() == ()
    assert driver.read().v == pytest.approx(np.full(7, STEP), rel=0.05)


def test_a_second_motion_starts_with_zeros_too():
    sdk = SlowFranka(3)
    driver = FrankaDriver(sdk, "fake", FR3, hand=False)
    for _ in range(2):
        sdk.sent.clear()
        driver.enable()
        assert len(sdk.sent) >= 3 + FOLLOWING_STATES
        assert not np.any(sdk.sent)
        driver.wait()
        driver.write(command(STEP))
        driver.wait()
        assert driver.faults() == ()
        driver.stop()


def test_an_arm_that_never_follows_is_a_fault():
    sdk = FakeFranka(FR3)
    sdk.controller.command = lambda u: None
    sdk.controller._violated_flag = lambda u: ""  # otherwise 20 missed packets end the motion
    driver = FrankaDriver(sdk, "fake", FR3, hand=False)
    driver.enable()
    assert not driver.read().drive_enabled
    assert driver.faults() == (f"the arm did not follow within {MAX_START_STATES} states after the start of a motion",)
    assert sdk.controller.mode is RobotMode.Idle


def test_a_reflex_during_the_start_is_reported():
    sdk = FakeFranka(FR3)
    step, remaining = sdk.controller.step, [3]

    def collide():
        step()
        remaining[0] -= sdk.controller.mode is RobotMode.Move
        if remaining[0] == 0:
            sdk.controller.collide()

    sdk.controller.step = collide
    driver = FrankaDriver(sdk, "fake", FR3, hand=False)
    driver.enable()
    assert not driver.read().drive_enabled
    assert "joint_reflex" in driver.faults()[0]
    driver.wait()
    driver.enable()
    assert driver.read().drive_enabled
    assert driver.faults() == ()


class StrictFranka(FakeFranka):
    """The library on a kernel without PREEMPT_RT."""

    def Robot(self, robot_ip_address, realtime_config=0):  # noqa: N802
        if realtime_config == self.RealtimeConfig.kEnforce:
            raise self.RealtimeException("libfranka: Running kernel does not have realtime capabilities.")
        return super().Robot(robot_ip_address, realtime_config)


def test_a_kernel_without_preempt_rt_is_refused_by_default_and_the_error_names_the_option():
    with pytest.raises(ConfigurationError, match="realtime capabilities") as refused:
        FrankaDriver(StrictFranka(FR3), "10.0.0.2", FR3, hand=False)
    for words in ("10.0.0.2", "PREEMPT_RT", "realtime='ignore'", "--realtime ignore"):
        assert words in str(refused.value)
    driver = FrankaDriver(StrictFranka(FR3), "10.0.0.2", FR3, hand=False, realtime="ignore")
    driver.enable()
    assert driver.read().drive_enabled


def test_another_word_for_realtime_is_refused():
    with pytest.raises(ConfigurationError, match="realtime of the Franka driver"):
        FrankaDriver(FakeFranka(FR3), "fake", FR3, hand=False, realtime="off")


def test_only_the_franka_drivers_have_the_option():
    for kind in DRIVER_KINDS:
        assert kind.check_realtime("enforce") == "enforce"
        with pytest.raises(ConfigurationError, match="realtime"):
            kind.check_realtime("never")
        if "franka" in kind.name:
            assert kind.check_realtime("ignore") == "ignore"
        else:
            with pytest.raises(ConfigurationError, match="no option for the real-time kernel"):
                kind.check_realtime("ignore")
    kind = find_driver_kind("fake_franka", "fr3")
    assert kind.open("fake", FR3, None, realtime=kind.check_realtime("ignore")).read().q == pytest.approx(FR3.home)


@pytest.mark.parametrize(("jerk_limits", "reflex"), [(True, ""), (False, "acceleration_discontinuity")])
def test_joint_ends_are_reached_at_full_speed_without_a_reflex_only_with_jerk_limits(jerk_limits, reflex):
    """The arm aborts a motion for every excess of velocity, acceleration or jerk; the first wish follows `enable`."""
    joints = tuple(
        msgspec.structs.replace(
            joint,
            **{
                name: msgspec.structs.replace(getattr(joint, name), value=0.97 * getattr(joint, name).value)
                for name in ("velocity", "acceleration", "jerk")
            },
        )
        for joint in FR3.joints
    )
    robot = msgspec.structs.replace(FR3, joints=joints)
    driver = FrankaDriver(FakeFranka(robot), "fake", robot, hand=False)
    driver.enable()
    safety = SafetyFilter(robot, FilterConfig(jerk_limits=jerk_limits))
    lower, upper, v_max = (
        np.array([getattr(joint, name).value for joint in joints]) for name in ("lower", "upper", "velocity")
    )
    turning = np.array([1.0, 0.0, -1.0, 0.0, 1.0, 0.0, -1.0])
    closest = np.full(7, np.inf)
    for side in (1.0, -1.0):
        for _ in range(4500):
            driver.wait()
            state = driver.read()
            driver.write(Command(safety(state.q, state.v, side * turning * v_max).u, 0.0, 0.0))
        closest = np.minimum(closest, np.minimum(state.q - lower, upper - state.q))
    assert reflex in "".join(driver.faults())
    assert bool(driver.faults()) == bool(reflex)
    assert reflex or np.all(closest[turning != 0.0] < 0.01)
