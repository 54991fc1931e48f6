"""Unusable actions, joint states and times bring the arm to rest with a reason, and a good action moves it again."""

from math import inf, nan

import numpy as np
import pytest

from dualbrain.errors import ConfigurationError
from dualbrain.robots.loader import load_robot
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.safety.integration.policy_guard.guard import GuardLimits, PolicyGuard
from dualbrain.safety.integration.policy_guard.joint_actions import JointPosition
from dualbrain.safety.integration.policy_guard.tool_actions import ToolPose, ToolTwist
from dualbrain.safety.integration.policy_guard.torque_actions import JointTorque
from tests.safety.integration.gym_environments import DERATED_PANDA, PERIOD, V_MAX, TorqueEnv
from tests.safety.integration.policy_guard.kinematic_arm import GRIPPER, HOME, SPACES, make_guard, random_action

BAD_ACTIONS = [
    np.full(8, nan),
    np.full(8, inf),
    np.zeros(3),
    np.zeros(0),
    np.zeros((8, 8)),
    "full speed",
    b"\x00\xff",
    None,
    {"q": 1.0},
    [1.0, None],
    [[1.0], [2.0, 3.0]],
    object(),
    np.array([1 + 2j] * 8),
]
BAD_STATES = [np.full(7, nan), np.full(7, inf), np.zeros(6), np.zeros((7, 1)), "home", None, [None] * 7]


def moving_guard(space):
    """A guard in the middle of a motion, with the joint state there."""
    guard, q, v = make_guard(space, obstacles=()), HOME.copy(), np.zeros(7)
    guard.reset(q)
    for _ in range(5):
        guard(random_action(space, np.random.default_rng(3), q, speed=0.3), q, v)
        q, v = guard.target, guard.control
    return guard, q, v


def bring_to_rest(guard, q, v, action):
    """Repeat an unusable action until the arm rests; no period may be faster than the one before."""
    for _ in range(60):
        applied = guard(action, q, v)
        assert np.isfinite(np.asarray(applied, float)).all()
        assert "the arm comes to rest" in guard.report.problem
        assert (np.abs(guard.control) <= np.abs(v) + 1e-6).all()
        q, v = guard.target, guard.control
    return q, v


@pytest.mark.parametrize("space", SPACES)
@pytest.mark.parametrize("action", BAD_ACTIONS, ids=lambda value: type(value).__name__)
def test_an_unusable_action_brings_the_arm_to_rest_and_the_next_good_one_moves_it(space, action):
    guard, q, v = moving_guard(space)
    if isinstance(action, np.ndarray) and action.shape == (8,):
        action = np.resize(action, SPACES[space].count(7) + 1)
    q, v = bring_to_rest(guard, q, v, action)
    assert np.abs(v).max() < 1e-6
    guard(random_action(space, np.random.default_rng(3), q, speed=0.3), q, v)
    assert not guard.report.problem
    assert np.abs(guard.control).max() > 1e-3


@pytest.mark.parametrize("space", SPACES)
@pytest.mark.parametrize("state", BAD_STATES, ids=lambda value: type(value).__name__)
@pytest.mark.parametrize("which", ["q", "v"])
def test_an_unusable_joint_state_stops_the_command(space, state, which):
    guard, q, v = moving_guard(space)
    action = random_action(space, np.random.default_rng(3), q, speed=0.3)
    applied = guard(action, state if which == "q" else q, state if which == "v" else v)
    assert guard.report.problem
    assert np.isfinite(applied).all()
    assert not np.array_equal(applied, action)
    guard(action, q, np.zeros(7))
    assert not guard.report.problem


@pytest.mark.parametrize("now", [nan, inf, -inf, 0.0, -1e9])
def test_a_clock_that_does_not_advance_stops_the_arm(now):
    guard = make_guard("joint velocity", obstacles=())
    action = np.append(0.1 * V_MAX, GRIPPER)
    guard(action, HOME, np.zeros(7), 10.0)
    guard(action, HOME, guard.control, now)
    assert "clock" in guard.report.problem
    assert np.abs(guard.control).max() < 1e-6 or np.abs(guard.control).max() < 0.1


def test_a_policy_that_stops_responding_brings_the_arm_to_rest():
    guard, q, v = make_guard("joint velocity", obstacles=(), limits=GuardLimits(action_timeout=0.1)), HOME, np.zeros(7)
    guard.begin(np.append(0.2 * V_MAX, GRIPPER), 0.0)
    for step in range(100):
        result = guard.step(q, v, step * PERIOD)
        q, v = q + PERIOD * result.u, result.u
    assert np.abs(v).max() < 1e-6
    assert "The last action ended" in guard.report.problem


def test_a_joint_that_does_not_follow_its_command_stops_it():
    guard, limits = make_guard("joint position", obstacles=(), limits=GuardLimits(following_error=0.1)), []
    guard.reset(HOME)
    for _ in range(300):  # the first joint is blocked
        q = guard.target.copy()
        q[0] = HOME[0]
        guard(np.append(HOME + 1.0, GRIPPER), q, np.zeros(7))
        limits.append(abs(guard.target[0] - HOME[0]))
    assert "panda_joint1 is 0.1" in guard.report.problem
    braking = V_MAX[0] ** 2 / (2.0 * DERATED_PANDA.joints[0].acceleration.value)
    assert max(limits) < 0.1 + 4 * PERIOD * V_MAX[0] + braking


@pytest.mark.parametrize("space", ["joint velocity", "joint position", "tool pose"])
def test_a_first_action_that_is_unusable_is_an_error_because_no_layout_is_known(space):
    with pytest.raises(ConfigurationError, match="No action can stop the arm"):
        make_guard(space)(np.full(8, nan), HOME, np.zeros(7))


def test_no_torque_stops_an_arm_whose_state_is_unknown():
    env = TorqueEnv()
    env.reset(seed=0)
    guard = PolicyGuard(SafetyFilter(load_robot("panda")), JointTorque(drive=env))
    guard(np.zeros(7), HOME, np.zeros(7))
    with pytest.raises(ConfigurationError, match="Stop its drives"):
        guard(np.zeros(7), np.full(7, nan), np.zeros(7))


@pytest.mark.parametrize("space", ["joint velocity", "joint position", "tool pose"])
def test_a_policy_that_stalled_between_two_calls_is_reported_and_braked(space):
    guard, action = make_guard(space, obstacles=()), random_action(space, np.random.default_rng(3), HOME, speed=0.1)
    guard.reset(HOME)
    guard(action, HOME, np.zeros(7), 0.0)
    guard(action, guard.target, guard.control, 5.0)
    assert "The last action ended 4.98 s ago" in guard.report.problem
    guard(action, guard.target, guard.control, 5.02)
    assert not guard.report.problem


class Unconvertible:
    """A value whose conversion to an array fails as that of a tensor with a gradient."""

    def __init__(self, error):
        self.error = error

    def __len__(self):
        return 8

    def __array__(self, dtype=None, copy=None):
        raise self.error


@pytest.mark.parametrize("error", [RuntimeError("requires grad"), OverflowError("too large")], ids=["grad", "overflow"])
def test_a_value_that_no_array_can_hold_brings_the_arm_to_rest(error):
    guard, q, v = moving_guard("joint velocity")
    guard(Unconvertible(error), q, v)
    assert "the arm comes to rest" in guard.report.problem
    guard(np.append(V_MAX, GRIPPER), Unconvertible(error), v)
    assert guard.report.problem


def test_an_unknown_configuration_at_the_reset_is_that_of_the_first_step():
    guard = make_guard("joint position", obstacles=())
    guard.reset(np.full(7, nan))
    guard(np.append(HOME, GRIPPER), HOME, np.zeros(7))
    assert not guard.report.problem
    np.testing.assert_allclose(guard.target, HOME, atol=1e-6)


@pytest.mark.parametrize("deviation", ["nearest", "along_path"])
@pytest.mark.parametrize("unknown", [nan, inf, -inf])
def test_an_unknown_velocity_at_the_reset_is_that_of_an_arm_at_rest(unknown, deviation):
    actions = {}
    for start in (0.0, unknown):
        guard = make_guard("joint velocity", obstacles=(), deviation=deviation)
        guard.reset(HOME, np.where(np.arange(7) == 2, start, 0.0))
        actions[start] = guard(np.append(0.2 * V_MAX, GRIPPER), HOME, np.zeros(7))
        assert not guard.report.problem
    np.testing.assert_array_equal(actions[unknown], actions[0.0])


@pytest.mark.parametrize(
    "make",
    [
        lambda: ToolTwist(frame="base"),
        lambda: ToolPose(frame="hand"),
        lambda: ToolPose(rotation="euler"),
        lambda: JointPosition(reference="desired"),
        lambda: GuardLimits(following_error=nan),
        lambda: GuardLimits(action_timeout=nan),
        lambda: GuardLimits(action_timeout=-1.0),
    ],
)
def test_an_option_without_a_meaning_is_an_error(make):
    with pytest.raises(ConfigurationError, match="allowed"):
        make()
