"""The guard: no policy in any action space brings h below zero, and an action that is safe passes unchanged."""

import msgspec
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dualbrain.errors import ConfigurationError
from dualbrain.robots.importer.build_arm import unidentified_tracking
from dualbrain.robots.loader import load_robot
from dualbrain.safety.cbf.config import FilterConfig, operating_config
from dualbrain.safety.cbf.filter import FilterStatus, SafetyFilter
from dualbrain.safety.integration.policy_guard.action_layout import ActionLayout
from dualbrain.safety.integration.policy_guard.guard import PolicyGuard
from dualbrain.safety.integration.policy_guard.joint_actions import JointPosition, JointVelocity
from dualbrain.safety.integration.policy_guard.tool_actions import ToolPose, ToolTwist
from dualbrain.safety.integration.policy_guard.torque_actions import JointTorque
from dualbrain.safety.integration.shadow_mode import ShadowFilter
from tests.safety.integration.gym_environments import (
    DERATED_PANDA,
    EXACT_CONFIG,
    OBSTACLES,
    PERIOD,
    TorqueEnv,
    min_h,
)
from tests.safety.integration.policy_guard.kinematic_arm import (
    GRIPPER,
    HOME,
    KINEMATICS,
    SPACES,
    make_guard,
    random_action,
    scaled,
)

TOLERANCE = 2e-6
"""Rounding of the kernel, on the motion of a joint in one period [rad or m]."""


def run_policy(space, seed, actions=60, steps=4):
    """Joint angles in every period of the filter and the reports, for a policy that changes its direction at times."""
    guard, rng, q, v = make_guard(space, steps), np.random.default_rng(seed), HOME.copy(), np.zeros(7)
    guard.reset(q)
    visited, reports = [], []
    for index in range(actions):
        if index % 15 == 0:
            directions = rng.integers(2**32)
        action = random_action(space, np.random.default_rng(directions), q, steps=steps)
        applied = guard(action, q, v)
        assert applied[-1] == GRIPPER
        visited.append(q := guard.target)
        v = guard.control
        reports.append(guard.report)
    return np.array(visited), reports


@pytest.mark.parametrize("space", SPACES)
def test_no_policy_brings_h_below_zero_and_the_filter_intervenes(space):
    for seed in range(3):
        visited, reports = run_policy(space, seed)
        assert min_h(visited) > -TOLERANCE
        assert {report.status for report in reports} <= {FilterStatus.SAFE, FilterStatus.MODIFIED}
        assert not any(report.problem for report in reports)
    assert max(report.delta for report in reports) > 0.02


@pytest.mark.parametrize("space", SPACES)
def test_a_slow_safe_action_is_returned_as_it_is(space):
    guard, q = make_guard(space, obstacles=()), HOME.copy()
    guard.reset(q)
    action = random_action(space, np.random.default_rng(1), q, speed=0.01)
    assert guard(action, q, np.zeros(7)) is action
    assert (guard.report.changed, guard.report.delta, guard.report.status) == (False, 0.0, FilterStatus.SAFE)


def test_one_period_of_velocities_equals_the_filter_itself():
    guard, twin = make_guard("joint velocity", steps=1), SafetyFilter(DERATED_PANDA, EXACT_CONFIG, obstacles=OBSTACLES)
    rng, q, v = np.random.default_rng(4), HOME.copy(), np.zeros(7)
    for step in range(200):
        action = random_action("joint velocity", rng, q, steps=1)
        applied = guard(action, q, v)
        expected = twin(q, v, action[:7], step * PERIOD)
        np.testing.assert_array_equal(guard.control, expected.u)
        np.testing.assert_allclose(applied[:7], expected.u, atol=1e-12)
        q, v = q + PERIOD * expected.u, expected.u


def test_a_loop_that_measures_in_every_period_equals_one_call_if_the_joints_follow_exactly():
    once, loop = make_guard("joint position"), make_guard("joint position")
    rng, q, v = np.random.default_rng(5), HOME.copy(), np.zeros(7)
    for index in range(40):
        action, start = random_action("joint position", rng, q), index * 4 * PERIOD
        applied = once(action, q, v, start)
        loop.begin(action, start)
        for step in range(4):
            result = loop.step(q, v, start + step * PERIOD)
            q, v = loop.target, result.u
        np.testing.assert_allclose(loop.command(), applied, atol=1e-12)


@pytest.mark.parametrize("space", [space for space in SPACES if "delta" not in space and "quaternion" not in space])
def test_the_units_of_a_policy_do_not_change_the_motion(space):
    plain, other = make_guard(space), make_guard(scaled(SPACES[space], 0.25, 0.5))
    action = random_action(space, np.random.default_rng(7), HOME)
    values = plain(action, HOME, np.zeros(7))
    in_units = other(np.append((action[:-1] - 0.5) / 0.25, GRIPPER), HOME, np.zeros(7))
    np.testing.assert_allclose(0.25 * in_units[:-1] + 0.5, values[:-1], atol=1e-9)
    np.testing.assert_allclose(plain.target, other.target, atol=1e-9)


def test_the_arm_may_have_any_entries_of_an_action():
    space = JointVelocity(layout=ActionLayout(entries=(8, 7, 6, 5, 4, 3, 2)))
    guard = make_guard(space)
    action = np.array([1, 2, 3, 4, 5, 6, 7, 8, 9], dtype=np.int64)
    applied = guard(action, HOME, np.zeros(7))
    np.testing.assert_array_equal(applied[:2], [1.0, 2.0])
    np.testing.assert_allclose(applied[[8, 7, 6, 5, 4, 3, 2]], (guard.target - HOME) / (4 * PERIOD), atol=1e-12)
    assert action.tolist() == [1, 2, 3, 4, 5, 6, 7, 8, 9]


def test_a_servo_with_a_constant_error_still_reaches_the_goal_of_a_relative_policy():
    """The joints stay 0.05 rad behind their command; the guard integrates the command and not the measurement."""
    guard, sag = make_guard(JointPosition(delta=True), obstacles=()), np.full(7, -0.05)
    guard.reset(HOME)
    q = HOME + sag
    for _ in range(50):
        guard(np.full(7, 1e-3), q, np.zeros(7))
        q = guard.target + sag
    np.testing.assert_allclose(guard.target, HOME + 0.05, atol=1e-9)


def test_commanded_positions_stay_within_the_joint_limits():
    """The joints stay 0.1 rad behind: the filter sees them within their limits when the command reaches them."""
    guard, upper = make_guard("joint position", obstacles=()), [joint.upper.value for joint in DERATED_PANDA.joints]
    guard.reset(HOME)
    for _ in range(400):
        guard(np.append(np.full(7, 9.0), GRIPPER), guard.target - 0.1, np.zeros(7))
    assert (guard.target <= np.array(upper) + 1e-9).all()
    assert (guard.target > np.array(upper) - 0.1).any()


@pytest.mark.parametrize("space", [space for space in SPACES if space.startswith("tool")])
def test_a_changed_tool_action_states_the_motion_of_the_commanded_configuration(space):
    """Against rotations by SciPy: the pose at the end, its change, or the mean twist, in the axes of the space."""
    chosen, guard = SPACES[space], make_guard(space)
    guard.reset(HOME)
    applied = guard(random_action(space, np.random.default_rng(11), HOME, speed=1.5), HOME, np.zeros(7))[:-1]
    assert guard.report.changed
    start, end = KINEMATICS.tool(HOME), KINEMATICS.tool(guard.target)
    axes = start.rotation if chosen.frame == "tool" else np.eye(3)
    moved, turned = axes.T @ (end.position - start.position), axes.T @ end.rotation @ start.rotation.T @ axes
    assert np.linalg.norm(moved) > 1e-4
    if isinstance(chosen, ToolTwist):
        moved = moved / (4 * PERIOD)
        expected = Rotation.from_matrix(turned).as_rotvec() / (4 * PERIOD)
        found = applied[3:] if chosen.angular else expected
    else:
        moved, turned = (moved, turned) if chosen.delta else (end.position, end.rotation)
        expected = Rotation.from_matrix(turned).as_matrix()
        w, *xyz = applied[3:] if chosen.rotation == "quaternion" else (1.0, 0.0, 0.0, 0.0)
        found = {
            "none": lambda: expected,
            "quaternion": lambda: Rotation.from_quat([*xyz, w]).as_matrix(),
            "rotation_vector": lambda: Rotation.from_rotvec(applied[3:]).as_matrix(),
        }[chosen.rotation]()
    np.testing.assert_allclose(applied[:3], moved, atol=1e-9)
    np.testing.assert_allclose(found, expected, atol=1e-6)


def test_shadow_mode_reports_and_changes_nothing():
    shadow = ShadowFilter(SafetyFilter(DERATED_PANDA, EXACT_CONFIG, obstacles=OBSTACLES))
    with pytest.raises(ConfigurationError, match=r"a ShadowFilter changes nothing.*nearest"):
        PolicyGuard(shadow, JointVelocity(), deviation="along_path")
    guard = PolicyGuard(shadow, JointVelocity())
    for action in (np.full(7, 1.5), np.full(7, np.nan)):
        assert guard(action, HOME, np.zeros(7)) is action
        assert not guard.report.changed
    assert shadow.close().changed_ticks >= 1


def test_a_torque_that_is_safe_passes_and_one_that_is_not_is_replaced():
    env = TorqueEnv()
    env.reset(seed=0)
    guard = PolicyGuard(SafetyFilter(load_robot("panda"), obstacles=OBSTACLES), JointTorque(drive=env))
    small, large = np.zeros(7), np.full(7, 80.0)
    observation = env._observation()
    assert guard(small, observation["q"], observation["v"]) is small
    assert not np.array_equal(guard(large, observation["q"], observation["v"]), large)


@pytest.mark.parametrize(
    ("space", "period", "robot", "message"),
    [
        (JointVelocity(), 0.0123, "panda", "multiple"),
        (JointVelocity(), float("nan"), "panda", "multiple"),
        (JointVelocity(), 0.0, "panda", "multiple"),
        (JointTorque(drive=None), 0.004, "panda", "torque"),
        (JointPosition(), None, "base", "mobile base"),
        (ToolPose(), None, "mobile_panda", "mobile base"),
        (JointVelocity(layout=ActionLayout(entries=(0, 1))), None, "panda", "entries"),
        (JointVelocity(layout=ActionLayout(entries=(0, 1, 2, 3, 4, 5, 5))), None, "panda", "entries"),
        (JointVelocity(layout=ActionLayout(scale=0.0)), None, "panda", "scale"),
        (JointVelocity(layout=ActionLayout(scale=(1.0, 2.0))), None, "panda", "scale"),
        (JointVelocity(layout=ActionLayout(offset=float("inf"))), None, "panda", "offset"),
    ],
)
def test_a_setup_that_does_not_fit_is_an_error(space, period, robot, message):
    with pytest.raises(ConfigurationError, match=message):
        PolicyGuard(SafetyFilter(load_robot(robot)), space, period=period)


def unidentified(name):
    """A packaged robot with the tracking model of an imported one."""
    return msgspec.structs.replace(load_robot(name), tracking=unidentified_tracking())


@pytest.mark.parametrize("make", [lambda safety: safety, ShadowFilter])
def test_a_robot_whose_tracking_error_is_not_identified_needs_a_stated_margin(make):
    robot_model = unidentified("panda")
    for config in (None, operating_config(robot_model)):
        with pytest.raises(ConfigurationError, match="tracking error of panda is not identified") as refused:
            PolicyGuard(make(SafetyFilter(robot_model, config)), JointVelocity())
        assert "dualbrain robot identify" in refused.value.fix
        assert "FilterConfig(tracking_error=...)" in refused.value.fix
    for margin in (0.0, 0.01, (0.0,) * 6 + (0.01,)):
        PolicyGuard(make(SafetyFilter(robot_model, FilterConfig(tracking_error=margin))), JointVelocity())


def test_a_base_is_guarded_with_velocities():
    guard = PolicyGuard(SafetyFilter(load_robot("base")), JointVelocity())
    action = np.array([0.05, 0.0])
    applied = guard(action, np.zeros(3), np.zeros(2))
    assert np.isfinite(applied).all()
    assert not guard.report.problem
