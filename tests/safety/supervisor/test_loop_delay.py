"""Delay of the control loop: which gaps are late, how the delay decays, and that no joint reaches its limit."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dualbrain.control.gatekeeper.robot_link.simulated_robot import WATCHDOG_TIMEOUT
from dualbrain.drivers.franka import FrankaDriver
from dualbrain.drivers.ur import UrDriver
from dualbrain.robots.interface import home_state
from dualbrain.robots.loader import load_robot
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.safety.supervisor.actions import SafetyAction
from dualbrain.safety.supervisor.controller import SafetyController
from dualbrain.safety.supervisor.loop_delay import LATE_TICK_PERIODS, MAX_DELAY, LoopDelay
from dualbrain.safety.supervisor.timing import FRANKA, SIMULATED, UR

DT = 1e-3
DRIVERS = {
    "panda": (SIMULATED, WATCHDOG_TIMEOUT),
    "fr3": (FRANKA, FrankaDriver.watchdog),
    "ur5e": (UR, UrDriver.watchdog),
}
ROBOTS = ("panda", "ur5e", "fr3", "base", "mobile_panda")
gaps = st.lists(st.floats(0.1 * DT, 80 * DT), min_size=1, max_size=40)


def delay_after(by_clock, by_robot, *, moving=True):
    """The delay b [s] after ticks with these gaps [s]."""
    loop_delay, now, stamp, found = LoopDelay(DT), 5.0, 2.0, 0.0
    loop_delay.update(now, stamp, moving=moving)
    for clock, robot in zip(by_clock, by_robot, strict=True):
        now, stamp = now + clock, stamp + robot
        found = loop_delay.update(now, stamp, moving=moving)
    return found


@given(gaps)
def test_the_delay_is_the_sum_of_late_gaps_minus_the_decay(late):
    expected = sum(gap - DT for gap in late if gap > LATE_TICK_PERIODS * DT)
    assert 0.0 <= delay_after(late, late) <= min(MAX_DELAY, expected) + 1e-9
    assert delay_after(late[-1:], late[-1:]) == pytest.approx(
        min(MAX_DELAY, late[-1] - DT) if late[-1] > LATE_TICK_PERIODS * DT else 0.0
    )


@given(gaps)
def test_a_single_clock_or_an_arm_at_rest_adds_no_delay(late):
    punctual = [DT] * len(late)
    assert delay_after(late, punctual) == delay_after(punctual, late) == delay_after(late, late, moving=False) == 0.0


@pytest.mark.parametrize("wrong", [np.nan, np.inf, -np.inf, -10.0])
def test_impossible_times_leave_a_valid_delay(wrong):
    loop_delay = LoopDelay(DT)
    for now, stamp in ((0.0, 0.0), (wrong, DT), (2 * DT, wrong), (wrong, wrong), (4 * DT, 4 * DT)):
        assert 0.0 <= loop_delay.update(now, stamp, moving=True) <= MAX_DELAY


@pytest.mark.parametrize(
    ("robot", "timing", "watchdog"),
    [*((robot, *how) for robot, how in DRIVERS.items()), *((robot, SIMULATED, WATCHDOG_TIMEOUT) for robot in ROBOTS)],
)
def test_no_joint_reaches_its_limit_before_a_late_loop_is_stopped(robot, timing, watchdog):
    """Before the stop the delay is at most `max_loop_delay` plus one gap, which the watchdog of the robot limits."""
    alpha = min(joint.acceleration.value / joint.velocity.value for joint in load_robot(robot).joints)
    assert alpha * (timing.max_loop_delay + watchdog) < 1.0


@pytest.mark.parametrize("robot", DRIVERS)
def test_a_loop_of_ten_periods_per_tick_is_stopped_by_the_drive_and_a_single_gap_is_not(robot):
    robot_model, (timing, _) = load_robot(robot), DRIVERS[robot]
    controller, state, checks = SafetyController(SafetyFilter(robot_model), timing=timing), home_state(robot_model), []
    v = np.zeros(robot_model.n)
    for count in range(400):
        gap = (10 if count >= 200 else 3 if count == 50 else 1) * timing.period
        state = replace(state, stamp=state.stamp + gap, sequence=count + 1, q=state.q + gap * v, v=v)
        controller.accept_state(state, state.stamp)
        checks.append(controller.decide(state, state.stamp).check)
        if not controller.drive_wanted:
            break
        v = controller.control(state, np.full(robot_model.n, 0.05), state.stamp).u
    assert set(checks[:200]) <= {"", "tick_overrun"}
    assert (checks[-1], controller.decision.action) == ("loop_behind", SafetyAction.CONTROLLED_STOP)
    assert (len(checks) - 201) * 10 * timing.period < timing.max_loop_delay + 0.02
    assert np.abs(v).max() > 0.04, "the drive brakes, not the late filter"


@pytest.mark.parametrize("robot", ROBOTS)
def test_a_tick_of_the_robots_own_period_is_not_late(robot):
    robot_model = load_robot(robot)
    controller, state = SafetyController(SafetyFilter(robot_model)), home_state(robot_model)
    u = np.array([0.5 * joint.velocity.value for joint in robot_model.joints]) * 0.01
    for count in range(30):
        state = replace(state, stamp=state.stamp + robot_model.period, sequence=count + 1)
        assert controller.decide(state, state.stamp).check == ""
        controller.control(state, u, state.stamp)
