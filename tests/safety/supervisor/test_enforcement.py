"""Whatever the body: brakes that hold are believed, brakes that do not hold and a standstill that drifts are told."""

from dataclasses import replace

import numpy as np
import pytest

from dualbrain.robots.interface import home_state
from dualbrain.robots.loader import load_robot
from dualbrain.safety.supervisor.actions import SafetyAction, SupervisorDecision
from dualbrain.safety.supervisor.conditions import Condition
from dualbrain.safety.supervisor.enforcement import Enforcement

ROBOTS = ("panda", "fr3", "ur5e", "base", "mobile_panda")


def obeyed(robot, rung, speed, far, axis=0):
    """The bits after a second under `rung`, begun at `speed`, in which coordinate `axis` came `far`."""
    enforcement, state = Enforcement(), home_state(load_robot(robot))
    q, flags = state.q.copy(), 0
    for k in range(11):
        q[axis] = state.q[axis] + far * k / 10
        v = np.full(len(state.v), speed if k == 0 else 0.0)
        flags = enforcement.apply(SupervisorDecision(rung), replace(state, stamp=0.1 * k, q=q.copy(), v=v))
    return flags


@pytest.mark.parametrize("robot", ROBOTS)
def test_a_drive_that_was_cut_may_coast_as_far_as_its_speed_explains(robot):
    assert obeyed(robot, SafetyAction.ESTOP, 0.1, 0.04) == 0
    for axis in range(len(load_robot(robot).home)):
        assert obeyed(robot, SafetyAction.ESTOP, 0.1, 0.2, axis) & Condition.FALLING


@pytest.mark.parametrize("robot", ROBOTS)
def test_a_standstill_is_watched_in_every_direction(robot):
    assert obeyed(robot, SafetyAction.HOLD, 0.0, 0.005) == 0
    for axis in range(len(load_robot(robot).home)):
        assert obeyed(robot, SafetyAction.HOLD, 0.0, 0.03, axis) & Condition.DRIFT
