"""The executive by its own clock, on the host: rates, resets, and messages that come too early."""

from itertools import pairwise

import numpy as np
import pytest

from dualbrain.robots.loader import load_robot
from dualbrain.safety.supervisor.actions import SafetyAction
from dualbrain.safety.supervisor.checks import CHECKS
from tests.firmware.hosted_firmware import HostedTarget, load_firmware

UR5E = load_robot("ur5e")
PERIOD = UR5E.period
STEP = PERIOD * min(joint.acceleration.value for joint in UR5E.joints)
"""Change of the velocity in one period at the acceleration limit of every joint [rad/s]."""


@pytest.fixture(scope="module")
def library(tmp_path_factory):
    return load_firmware(tmp_path_factory.mktemp("firmware"), UR5E)


@pytest.fixture
def target(library):
    return HostedTarget(library, UR5E)


def move(target, speed):
    """Accelerate all joints to `speed` [rad/s]; the last reply."""
    v = 0.0
    for _ in range(round(speed / STEP) + 2):
        reply = target.cycle(speed, v)
        v = reply.u[: UR5E.n]
    assert v == pytest.approx(speed, rel=1e-3)
    return reply


def test_without_a_host_the_arm_brakes_at_its_acceleration_limit(target):
    """A period of 2 ms: one output per period, each with the acceleration of one period."""
    acceleration = np.array([joint.acceleration.value for joint in UR5E.joints])
    moves, outputs = [(target.now, move(target, 0.5).u[: UR5E.n])], []
    for _ in range(300):
        target.wait(1000)
        outputs += (found := target.replies())
        moves += [(target.now, reply.u[: UR5E.n]) for reply in found]
    for (earlier, before), (later, after) in pairwise(moves[1:]):
        if later - earlier < 0.02 and after.any():
            assert later - earlier >= 0.999 * PERIOD
            assert (np.abs(after - before) <= 1.001 * acceleration * (later - earlier)).all()
    assert sum(u.any() for _, u in moves) > 10
    assert CHECKS[outputs[0].check].name == "state_stale"
    assert (outputs[-1].action, outputs[-1].drive_enabled) == (SafetyAction.ESTOP, False)
