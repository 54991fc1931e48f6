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


@pytest.mark.parametrize("name", ["desired_v", "desired_a"])
@pytest.mark.parametrize("bad", [[math.nan] * 7, [0.0] * 6, [math.inf] * 7])
def test_an_implausible_reported_command_makes_the_state_implausible(name, bad):
    controller = SafetyController(SafetyFilter(FR3), timing=FRANKA)
    assert controller.accept_state(home_state(FR3), 0.0)
    state = replace(home_state(FR3), stamp=1e-3, sequence=1, **{name: np.array(bad)})
    assert not controller.accept_state(state, 1e-3)
    assert controller._pending & Condition.STATE_IMPLAUSIBLE
