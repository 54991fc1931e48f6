"""The report of the guard names the kind of limit that changed an action, and `stop` brings the arm to rest."""

import numpy as np
import pytest

from dualbrain.errors import ConfigurationError
from dualbrain.safety.cbf.filter import ConstraintRow, SafetyFilter
from dualbrain.safety.cbf.result import FilterStatus, LimitKind
from tests.safety.integration.gym_environments import DERATED_PANDA, EXACT_CONFIG, V_MAX
from tests.safety.integration.policy_guard.kinematic_arm import GRIPPER, HOME, make_guard, random_action


def final_report(guard, action, cycles=40):
    """The report after some cycles with the same action, on an arm that follows exactly."""
    q, v = HOME.copy(), np.zeros(7)
    for _ in range(cycles):
        guard(action, q, v)
        q, v = guard.target, guard.control
    return guard.report


def position(joint, change):
    q = HOME.copy()
    q[joint] += change
    return np.append(q, GRIPPER)


def test_an_unchanged_action_has_no_limit():
    report = final_report(make_guard("joint position", obstacles=()), position(0, 1e-5), cycles=1)
    assert (report.changed, report.limit) == (False, LimitKind.NONE)


@pytest.mark.parametrize(
    ("change", "cycles", "limit", "text"),
    [
        (2.0, 1, LimitKind.SPEED, "panda_joint1 acceleration limit"),
        (2.0, 25, LimitKind.SPEED, "panda_joint1 moves at 100 % of its velocity limit"),
        (4.0, 120, LimitKind.JOINT_POSITION, "panda_joint1 position limit"),
    ],
)
def test_a_bound_is_named_with_its_joint(change, cycles, limit, text):
    report = final_report(make_guard("joint position", obstacles=()), position(0, change), cycles)
    assert report.limit is limit
    assert text in report.explanation


def test_an_unchanged_control_of_a_relaxed_step_is_not_explained_by_the_duration():
    """Two rows that contradict each other leave an action of zero as it is."""
    guard, joint = make_guard("joint velocity", obstacles=()), np.eye(7)[0]
    rows = {"up": joint, "down": -joint}
    guard.safety.constrain([ConstraintRow(name=name, a=tuple(a.tolist()), b=0.01) for name, a in rows.items()])
    guard(np.append(np.zeros(7), GRIPPER), HOME, np.zeros(7))
    report = guard.report
    assert (report.status, report.delta, report.changed) == (FilterStatus.RELAXED, 0.0, True)
    assert report.limit is LimitKind.CONSTRAINT
    assert "no control meets all of: up and down" in report.explanation


def test_the_kind_of_a_row_is_that_of_the_limiting_row():
    safety = SafetyFilter(DERATED_PANDA, EXACT_CONFIG)
    safety.constrain([ConstraintRow(name="first_joint", a=tuple(np.eye(7)[0]), b=0.01)])  # u_1 >= 0.01 rad/s
    result = safety(HOME, np.zeros(7), np.zeros(7), 0.0)
    assert result.limiting_row == "first_joint"
    assert result.limit_kind is LimitKind.CONSTRAINT


def test_a_stop_without_a_row_is_a_stop():
    result = SafetyFilter(DERATED_PANDA, EXACT_CONFIG)(np.full(7, np.nan), np.zeros(7), np.zeros(7), 0.0)
    assert result.limit_kind is LimitKind.STOP


def test_stop_brings_the_arm_to_rest_within_its_limits_and_reports_the_problem():
    guard, q, v = make_guard("joint velocity", obstacles=()), HOME.copy(), np.zeros(7)
    action = random_action("joint velocity", np.random.default_rng(1), q, speed=0.5)
    for _ in range(10):
        guard(action, q, v)
        q, v = q + 4 * DERATED_PANDA.period * guard.control, guard.control
    assert np.abs(v / V_MAX).max() > 0.3
    speeds = []
    for _ in range(20):
        stopped = guard.stop("the operator left", q, v)
        assert (guard.report.problem, guard.report.limit) == ("the operator left", LimitKind.INPUT)
        speeds.append(np.abs(guard.control).max())
        q, v = q + 4 * DERATED_PANDA.period * guard.control, guard.control
    assert (np.diff(speeds) <= 1e-6).all()
    assert speeds[-1] < 1e-6
    assert stopped[-1] == action[-1]


def test_stop_before_any_action_is_an_error():
    with pytest.raises(ConfigurationError, match="No action can stop the arm"):
        make_guard("joint velocity").stop("no state", HOME, np.zeros(7))
