"""A Franka arm that does not receive a command continues by itself, and the next command continues from there."""

import math
from dataclasses import replace

import numpy as np
import pytest

from dualbrain.drivers.fakes.franka import FakeFranka
from dualbrain.drivers.franka import FrankaDriver
from dualbrain.robots.interface import Command, home_state
from dualbrain.robots.loader import load_robot
from dualbrain.safety.cbf.filter import FilterConfig, SafetyFilter
from dualbrain.safety.stop_cause import Reason
from dualbrain.safety.supervisor.actions import SafetyAction
from dualbrain.safety.supervisor.conditions import Condition
from dualbrain.safety.supervisor.controller import SafetyController
from dualbrain.safety.supervisor.timing import FRANKA

FR3 = load_robot("fr3")
V_MAX = np.array([joint.velocity.value for joint in FR3.joints])


def move(*, follow, lost=(1, 2, 5), ticks=1500):
    """Random motion with runs of lost commands; returns the faults of the arm and the number of continued commands."""
    rng, sdk = np.random.default_rng(2), FakeFranka(FR3)
    driver = FrankaDriver(sdk, "fake", FR3, hand=False)
    controller = SafetyController(SafetyFilter(FR3, FilterConfig(jerk_limits=True)), timing=FRANKA)
    driver.enable()
    continued, lose, wish = 0, 0, np.zeros(7)
    for tick in range(ticks):
        if tick % 150 == 0:
            wish = rng.uniform(-0.6, 0.6, 7) * V_MAX
        if tick % 40 == 20:
            lose = int(rng.choice(lost))
        driver.wait()
        state = driver.read()
        if driver.faults():
            break
        if follow:
            continued += controller.continue_desired_motion(state) is not None
        result = controller.control(state, wish, state.stamp)
        if lose > 0:
            lose -= 1
        else:
            driver.write(Command(result.u, 0.0, 0.0))
    return driver.faults(), continued


def test_the_motion_goes_on_after_lost_commands():
    faults, continued = move(follow=True)
    assert faults == ()
    assert continued > 30


def test_without_the_reported_command_the_arm_aborts_the_motion():
    """Negative control: the limits around a command that the arm has not executed do not bound the jerk."""
    faults, _ = move(follow=False)
    assert "acceleration_discontinuity" in faults[0]


def test_a_robot_that_reports_no_command_executes_every_control():
    assert home_state(FR3).executes(np.full(7, 0.3))


def test_a_state_reports_a_lost_command_once():
    """A later command cannot be in the same state, so that it is not lost."""
    controller = SafetyController(SafetyFilter(FR3), timing=FRANKA)
    moving = {"desired_v": np.full(7, 0.01), "desired_a": np.zeros(7)}
    state = replace(home_state(FR3), **moving)
    assert controller.continue_desired_motion(state) is not None
    controller.control(state, np.zeros(7), state.stamp)
    assert controller.continue_desired_motion(state) is None
    assert controller.continue_desired_motion(replace(state, stamp=1e-3, sequence=1)) is not None


@pytest.mark.parametrize(("silence", "stopped"), [(0.3, False), (0.6, True)])
def test_a_filter_without_states_is_no_fault_while_the_drive_is_being_switched_on(silence, stopped):
    controller, state = (
        SafetyController(SafetyFilter(FR3), timing=FRANKA),
        replace(home_state(FR3), drive_enabled=False),
    )
    controller.accept_state(state, 0.0)
    controller.expect_drive_on(state, 0.0)
    for tick in range(round(silence / 1e-3)):
        now = 1e-3 * tick
        controller.report(controller.monitor.check_age(now))
        controller.decide(state, now)
        controller.control(state, np.zeros(7), now)
    assert (controller.decision.action >= SafetyAction.CONTROLLED_STOP) == stopped


@pytest.mark.parametrize("name", ["desired_v", "desired_a"])
@pytest.mark.parametrize("bad", [[math.nan] * 7, [0.0] * 6, [math.inf] * 7])
def test_an_implausible_reported_command_makes_the_state_implausible(name, bad):
    controller = SafetyController(SafetyFilter(FR3), timing=FRANKA)
    assert controller.accept_state(home_state(FR3), 0.0)
    state = replace(home_state(FR3), stamp=1e-3, sequence=1, **{name: np.array(bad)})
    assert not controller.accept_state(state, 1e-3)
    assert controller._pending & Condition.STATE_IMPLAUSIBLE


def worst_jerk(seed, *, ticks=2500, most_lost=3):
    """Full speed to and fro with lost commands: the largest jerk in jerk limits, and the ticks that dropped them."""
    rng, period = np.random.default_rng(seed), FR3.period
    j_max = np.array([joint.jerk.value for joint in FR3.joints])
    safety = SafetyFilter(FR3, FilterConfig(jerk_limits=True))
    q, v, a, u, before = np.array(FR3.home), *np.zeros((4, 7))
    lost, worst, dropped = 0, 0.0, 0
    for tick in range(ticks):
        if tick % 500 == 0:
            wish = rng.choice([-1.0, 0.0, 1.0], 7) * V_MAX
        if not np.allclose(v, u, atol=1e-12):
            safety.reset(v, a * period)
            u, before = v, v - a * period
        result = safety(q, v, wish)
        worst = max(worst, float((np.abs(result.u - 2.0 * u + before) / j_max).max()) / period**2)
        dropped += Reason.JERK in result.reason
        before, u = u, result.u
        lost = lost - 1 if lost > 0 else int(rng.integers(1, most_lost + 1)) if rng.random() < 0.03 else 0
        new = v + a * period if lost > 0 else u
        a, v = (new - v) / period, new
        q = q + v * period
    return worst, dropped


@pytest.mark.parametrize("seed", range(4))
def test_lost_commands_on_the_way_to_full_speed_leave_room_for_the_jerk_limit(seed):
    worst, dropped = worst_jerk(seed)
    assert dropped == 0
    assert worst < 1.001
