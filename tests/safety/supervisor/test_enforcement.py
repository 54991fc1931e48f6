"""Enforcement on every robot: working brakes are accepted, failing brakes and a drifting standstill are reported."""

from dataclasses import replace

import numpy as np
import pytest

from dualbrain.robots.interface import home_state
from dualbrain.robots.loader import load_robot
from dualbrain.safety.supervisor.actions import SafetyAction, SupervisorDecision
from dualbrain.safety.supervisor.conditions import Condition
from dualbrain.safety.supervisor.enforcement import Enforcement

ROBOTS = ("panda", "fr3", "ur5e", "base", "mobile_panda")


def flags_after_stop(robot, action, speed, distance, axis=0):
    """The bits after one second under `action`, started at `speed`, in which coordinate `axis` moved by `distance`."""
    enforcement, state = Enforcement(), home_state(load_robot(robot))
    q, flags = state.q.copy(), 0
    for k in range(11):
        q[axis] = state.q[axis] + distance * k / 10
        v = np.full(len(state.v), speed if k == 0 else 0.0)
        flags = enforcement.apply(SupervisorDecision(action), replace(state, stamp=0.1 * k, q=q.copy(), v=v))
    return flags


@pytest.mark.parametrize("robot", ROBOTS)
def test_a_drive_that_is_off_may_coast_as_far_as_its_speed_explains(robot):
    assert flags_after_stop(robot, SafetyAction.ESTOP, 0.1, 0.04) == 0
    for axis in range(len(load_robot(robot).home)):
        assert flags_after_stop(robot, SafetyAction.ESTOP, 0.1, 0.2, axis) & Condition.FALLING


@pytest.mark.parametrize("robot", ROBOTS)
def test_a_standstill_is_monitored_in_every_direction(robot):
    assert flags_after_stop(robot, SafetyAction.HOLD, 0.0, 0.005) == 0
    for axis in range(len(load_robot(robot).home)):
        assert flags_after_stop(robot, SafetyAction.HOLD, 0.0, 0.03, axis) & Condition.DRIFT


@pytest.mark.parametrize("robot", ROBOTS)
def test_a_drive_is_switched_on_only_at_rest(robot):
    enforcement, state = Enforcement(), home_state(load_robot(robot))
    enforcement.apply(SupervisorDecision(SafetyAction.ESTOP), state)
    for stamp, speed in ((0.1, 0.1), (0.2, float("nan")), (0.3, 0.0)):
        now = replace(state, stamp=stamp, v=np.full(len(state.v), speed))
        enforcement.apply(SupervisorDecision(), now)
        assert enforcement.drive_wanted == (speed == 0.0)
