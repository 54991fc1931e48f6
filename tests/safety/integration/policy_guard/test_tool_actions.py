"""A tool action passes unchanged only if it is the motion that the filter checked."""

import numpy as np
import pytest

from dualbrain.core.geometry.shapes import HalfSpace
from dualbrain.robots.loader import load_robot
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.safety.cbf.obstacles import Obstacle
from dualbrain.safety.cbf.result import LimitKind
from dualbrain.safety.integration.derating import derate
from dualbrain.safety.integration.policy_guard.action_space import GuardedArm
from dualbrain.safety.integration.policy_guard.guard import PolicyGuard
from dualbrain.safety.integration.policy_guard.tool_actions import ToolPose, ToolTwist, resolve
from tests.safety.integration.policy_guard.kinematic_arm import GRIPPER, HOME, KINEMATICS, make_guard

SLOW = derate(load_robot("panda"), period=0.001, max_speed=0.1)
"""A Panda whose filter runs at 1 ms and whose joints may move at 0.1 rad/s."""


def slow_guard(space):
    return PolicyGuard(SafetyFilter(SLOW, obstacles=[Obstacle("table", HalfSpace())]), space)


def joint_speeds(guard, actions):
    """Joint velocities (t, 7) [rad/s] of an arm that executes every returned twist exactly."""
    q, v, found = HOME.copy(), np.zeros(7), []
    for action in actions:
        twist = guard(action, q, v)
        v = np.linalg.pinv(guard.safety.tool(q).jacobian[: len(twist)]) @ twist
        q = q + SLOW.period * v
        found.append(v)
    return np.array(found)


def test_a_fast_twist_does_not_pass_when_the_guard_checked_a_slow_motion():
    guard = slow_guard(ToolTwist(angular=False))
    speeds = joint_speeds(guard, [np.array([0.3, 0.0, 0.0])] * 1000)
    assert np.abs(speeds).max() < 0.101


@pytest.mark.parametrize("way", [2e-4, 4e-4])
def test_relative_poses_do_not_add_up_to_more_than_the_checked_motion(way):
    guard = slow_guard(ToolPose(delta=True, rotation="none"))
    guard.reset(HOME)
    commanded, start = np.zeros(3), KINEMATICS.tool(HOME).position
    for _ in range(300):
        commanded += guard(np.array([way, 0.0, 0.0]), guard.target, guard.control)
    assert np.abs(commanded - (KINEMATICS.tool(guard.target).position - start)).max() < 1e-4


def test_a_motion_that_the_speed_limit_shortens_is_changed_for_any_excess():
    guard = slow_guard(ToolTwist(angular=False))
    direction = np.array([1.0, 0.0, 0.0])
    unit = np.linalg.pinv(KINEMATICS.tool(HOME).jacobian[:3]) @ direction
    fastest = 0.1 / np.abs(unit).max()
    guard.reset(HOME, unit * fastest)
    action = 1.001 * fastest * direction
    assert guard(action, HOME, unit * fastest) is not action
    assert guard.report.changed


def test_a_twist_into_a_singular_direction_is_changed_although_it_is_slow():
    """One direction needs far faster joints than the damped inverse gives them."""
    singular = np.array([0.0, 0.0, 1.57, -1.5, 0.0, 3.14, 0.0])
    left, values, _ = np.linalg.svd(KINEMATICS.tool(singular).jacobian)
    assert values[-1] < 1e-3
    guard = make_guard(ToolTwist(), obstacles=())
    action = np.append(1e-4 * left[:, -1], GRIPPER)
    assert guard(action, singular, np.zeros(7)) is not action
    assert np.abs(guard.control).max() < 0.02


def test_a_fast_twist_on_a_curve_is_reported_as_the_motion_that_was_checked():
    guard, twist = make_guard(ToolTwist(angular=False), obstacles=()), np.array([0.0, 0.7, 0.0])
    v = np.linalg.pinv(KINEMATICS.tool(HOME).jacobian[:3]) @ twist
    guard.reset(HOME, v)
    applied = guard(np.append(twist, GRIPPER), HOME, v)
    assert np.abs(applied[:3] - twist).max() < 0.005
    assert (guard.report.changed, guard.report.delta, guard.report.limit) == (True, 0.0, LimitKind.NONE)
    assert "the motion that the filter checked" in guard.report.explanation


def test_the_inverse_is_exact_where_the_arm_is_far_from_a_singularity():
    arm = GuardedArm(safety=KINEMATICS, velocity_limits=np.full(7, 9.0), q=HOME, v=np.zeros(7), start=HOME, target=HOME)
    twist = np.array([0.2, -0.1, 0.1, 0.3, 0.0, -0.2])
    np.testing.assert_allclose(KINEMATICS.tool(HOME).jacobian @ resolve(twist, arm), twist, atol=1e-12)
    assert not arm.shortened


@pytest.mark.parametrize("delta", [False, True])
@pytest.mark.parametrize("quaternion", [(0.0, 0.0, 0.0, 0.0), (2.0, 0.0, 0.0, 0.0), (0.5, 0.5, 0.0, 0.0)])
def test_a_quaternion_that_is_no_rotation_is_refused(delta, quaternion):
    guard = make_guard(ToolPose(rotation="quaternion", delta=delta), obstacles=())
    guard.reset(HOME)
    position = np.zeros(3) if delta else KINEMATICS.tool(HOME).position
    applied = guard(np.concatenate([position, quaternion, [GRIPPER]]), HOME, np.zeros(7))
    assert "the quaternion has the length" in guard.report.problem
    assert "Remedy" in guard.report.problem
    assert np.linalg.norm(applied[3:7]) == pytest.approx(1.0)
    assert np.abs(guard.control).max() < 1e-6
