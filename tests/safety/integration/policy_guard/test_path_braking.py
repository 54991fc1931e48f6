"""Braking along the path: the guarantee is the same, and the arm stays on the path of the policy where that is safe."""

import numpy as np
import pytest

from dualbrain.errors import ConfigurationError
from dualbrain.safety.cbf.filter import FilterStatus, SafetyFilter
from dualbrain.safety.integration.policy_guard.guard import PolicyGuard
from dualbrain.safety.integration.policy_guard.joint_actions import JointVelocity
from dualbrain.safety.integration.policy_guard.path_braking import brake_along_path, braking_step
from tests.safety.integration.gym_environments import DERATED_PANDA, EXACT_CONFIG, OBSTACLES, PERIOD, V_MAX, min_h
from tests.safety.integration.policy_guard.kinematic_arm import GRIPPER, HOME, make_guard, random_action

ACCELERATION = np.array([joint.acceleration.value for joint in DERATED_PANDA.joints])


def episode(deviation, seed, actions=60, space="joint velocity"):
    """Path, reports, and the share of the motion that is across the commanded direction."""
    guard, rng, q, v = make_guard(space, deviation=deviation), np.random.default_rng(seed), HOME.copy(), np.zeros(7)
    guard.reset(q)
    visited, reports, across = [], [], []
    for index in range(actions):
        if index % 15 == 0:
            directions = rng.integers(2**32)
        action = random_action(space, np.random.default_rng(directions), q)
        guard(action, q, v)
        moved, wanted = guard.target - q, action[:7]
        if index % 15 > 5 and np.linalg.norm(moved) > 1e-4:  # the change of direction takes some periods
            along = moved @ wanted / np.linalg.norm(wanted)
            across.append(np.sqrt(max(0.0, moved @ moved - along**2)) / np.linalg.norm(moved))
        q, v = guard.target, guard.control
        visited.append(q)
        reports.append(guard.report)
    return np.array(visited), reports, across


@pytest.mark.parametrize("space", ["joint velocity", "joint position", "tool pose"])
def test_no_policy_brings_h_below_zero(space):
    for seed in range(3):
        visited, reports, _ = episode("along_path", seed, space=space)
        assert min_h(visited) > -2e-6
        assert {report.status for report in reports} <= {FilterStatus.SAFE, FilterStatus.MODIFIED}
        assert min(report.speed_share for report in reports) < 0.5


def test_the_arm_stays_closer_to_the_path_of_the_policy_than_with_the_nearest_control():
    seeds = range(6)
    braking = [value for seed in seeds for value in episode("along_path", seed)[2]]
    nearest = [value for seed in seeds for value in episode("nearest", seed)[2]]
    assert np.mean(nearest) > 0.1
    assert np.mean(braking) < 0.5 * np.mean(nearest)


def test_free_space_is_the_same_in_both_modes():
    paths = []
    for deviation in ("nearest", "along_path"):
        guard, q, v = make_guard("joint velocity", obstacles=(), deviation=deviation), HOME.copy(), np.zeros(7)
        for _ in range(20):
            guard(np.append(0.2 * V_MAX, GRIPPER), q, v)
            q, v = guard.target, guard.control
        paths.append(q)
    np.testing.assert_allclose(paths[0], paths[1], atol=2e-3)  # the clip leaves 0.1 % of the acceleration


def test_the_chosen_control_is_admitted_and_a_faster_one_is_not():
    safety, rng, braked = SafetyFilter(DERATED_PANDA, EXACT_CONFIG, obstacles=OBSTACLES), np.random.default_rng(0), 0
    step = PERIOD * ACCELERATION
    for _ in range(1000):
        q, u_nom = HOME + rng.uniform(-0.7, 0.7, 7), V_MAX * rng.uniform(-1.0, 1.0, 7)
        found = brake_along_path(
            safety, braking_step(DERATED_PANDA), q, np.zeros(7), u_nom, u_prev := 0.5 * u_nom, 0.0, None
        )
        if found is None:
            continue
        control, share = found
        assert (np.abs(control - u_prev) <= step).all()
        safety.reset(u_prev)
        assert safety(q, np.zeros(7), control).delta <= 1e-6
        faster = np.clip(min(1.0, share + 0.01) * u_nom, u_prev - step, u_prev + step)
        if share < 1.0 and not np.allclose(faster, control):
            safety.reset(u_prev)
            braked += safety(q, np.zeros(7), faster).delta > 0.0
    assert braked > 10


def test_another_deviation_is_an_error():
    with pytest.raises(ConfigurationError, match="along_path"):
        make_guard("joint velocity", deviation="sideways")


class NoRows:
    """A Python barrier that never constrains."""

    name = "none"

    def rows(self, state, jacobian):
        del state, jacobian
        return []


def test_python_barriers_are_refused_before_the_first_action():
    safety = SafetyFilter(DERATED_PANDA, barriers=[NoRows()])
    PolicyGuard(safety, JointVelocity(), period=PERIOD)
    with pytest.raises(ConfigurationError, match="nearest"):
        PolicyGuard(safety, JointVelocity(), period=PERIOD, deviation="along_path")
