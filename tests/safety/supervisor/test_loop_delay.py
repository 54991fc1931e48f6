"""A loop that is behind the robot: what counts as late, when it is too much, and that no limit is reached meanwhile."""

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


def behind(by_clock, by_robot, *, moving=True):
    """B after ticks with these gaps [s]."""
    lateness, now, stamp, found = LoopDelay(DT), 5.0, 2.0, 0.0
    lateness.update(now, stamp, moving=moving)
    for clock, robot in zip(by_clock, by_robot, strict=True):
        now, stamp = now + clock, stamp + robot
        found = lateness.update(now, stamp, moving=moving)
    return found


@given(gaps)
def test_what_was_late_is_the_sum_less_what_is_forgotten(late):
    expected = sum(gap - DT for gap in late if gap > LATE_TICK_PERIODS * DT)
    assert 0.0 <= behind(late, late) <= min(MAX_DELAY, expected) + 1e-9
    assert behind(late[-1:], late[-1:]) == pytest.approx(
        min(MAX_DELAY, late[-1] - DT) if late[-1] > LATE_TICK_PERIODS * DT else 0.0
    )


@given(gaps)
def test_one_clock_alone_makes_nothing_late_nor_does_an_arm_that_stands(late):
    punctual = [DT] * len(late)
    assert behind(late, punctual) == behind(punctual, late) == behind(late, late, moving=False) == 0.0


@pytest.mark.parametrize("wrong", [np.nan, np.inf, -np.inf, -10.0])
def test_times_that_cannot_be_leave_a_sum_that_can(wrong):
    lateness = LoopDelay(DT)
    for now, stamp in ((0.0, 0.0), (wrong, DT), (2 * DT, wrong), (wrong, wrong), (4 * DT, 4 * DT)):
        assert 0.0 <= lateness.update(now, stamp, moving=True) <= MAX_DELAY


@pytest.mark.parametrize(
    ("robot", "timing", "watchdog"),
    [*((robot, *how) for robot, how in DRIVERS.items()), *((robot, SIMULATED, WATCHDOG_TIMEOUT) for robot in ROBOTS)],
)
def test_until_a_late_loop_is_stopped_no_joint_reaches_its_limit(robot, timing, watchdog):
    """Before the stop at most `behind` and one gap are late; no gap outlasts the robot's own watchdog."""
    alpha = min(joint.acceleration.value / joint.velocity.value for joint in load_robot(robot).joints)
    assert alpha * (timing.behind + watchdog) < 1.0


@pytest.mark.parametrize("robot", DRIVERS)
def test_a_loop_of_ten_periods_a_tick_is_stopped_by_the_drive_itself_and_a_hiccup_is_not(robot):
    robot_model, (timing, _) = load_robot(robot), DRIVERS[robot]
    spine, state, checks = SafetyController(SafetyFilter(robot_model), timing=timing), home_state(robot_model), []
    v = np.zeros(robot_model.n)
    for count in range(400):
        gap = (10 if count >= 200 else 3 if count == 50 else 1) * timing.period
        state = replace(state, stamp=state.stamp + gap, sequence=count + 1, q=state.q + gap * v, v=v)
        spine.accept_state(state, state.stamp)
        checks.append(spine.decide(state, state.stamp).check)
        if not spine.drive_wanted:
            break
        v = spine.control(state, np.full(robot_model.n, 0.05), state.stamp).u
    assert set(checks[:200]) <= {"", "tick_overrun"}
    assert (checks[-1], spine.decision.action) == ("loop_behind", SafetyAction.CONTROLLED_STOP)
    assert (len(checks) - 201) * 10 * timing.period < timing.max_loop_delay + 0.02
    assert np.abs(v).max() > 0.04, "it is the drive that brakes, not the late filter"


@pytest.mark.parametrize("robot", ROBOTS)
def test_a_tick_is_as_long_as_the_body_says_and_not_late_for_that(robot):
    robot_model = load_robot(robot)
    spine, state = SafetyController(SafetyFilter(robot_model)), home_state(robot_model)
    u = np.array([0.5 * joint.velocity.value for joint in robot_model.joints]) * 0.01
    for count in range(30):
        state = replace(state, stamp=state.stamp + robot_model.period, sequence=count + 1)
        assert spine.decide(state, state.stamp).check == ""
        spine.control(state, u, state.stamp)
