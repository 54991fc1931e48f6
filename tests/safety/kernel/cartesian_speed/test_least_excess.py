"""If no control keeps the speed limit with its reserve: the limit itself, then the least part of the excess of braking."""

import msgspec
import numpy as np
import pytest

from dualbrain.robots.loader import load_robot
from dualbrain.safety.cbf.filter import FilterConfig, SafetyFilter
from dualbrain.safety.stop_cause import Reason
from experiments.safety.speed_limits.least_share import control_bounds, least_share
from tests.safety.kernel.cartesian_speed.speed_oracle import SpeedOracle

ROOM = 0.0045
"""Share that the filter leaves for the approximation by cuts."""


def speeds(jacobians, u):
    """Speeds (k,) [m/s] of the points at u."""
    return np.linalg.norm(jacobians @ u, axis=1)


def random_state(robot_model, oracle, limit, rng):
    """A posture, its Jacobians, and a previous control with parts at 0.8 to 1.6 of the limit."""
    q = np.array(robot_model.home) + rng.uniform(-0.4, 0.4, robot_model.n)
    jacobians, direction = oracle.jacobian(q), rng.standard_normal(robot_model.n)
    return q, jacobians, direction * limit * rng.uniform(0.8, 1.6) / speeds(jacobians, direction).max()


@pytest.mark.parametrize("precision", ["float32", "float64"])
@pytest.mark.parametrize(("robot", "limit"), [("panda", 0.25), ("panda", 0.03), ("ur5e", 0.4)])
def test_a_limit_is_kept_if_a_control_keeps_it_and_no_part_is_faster_than_under_braking(robot, limit, precision):
    robot_model, rng = load_robot(robot), np.random.default_rng(17)
    robot_model = msgspec.structs.replace(
        robot_model, self_pairs=msgspec.structs.replace(robot_model.self_pairs, kept=())
    )
    config = FilterConfig(
        cartesian_speed=limit, lag_compensation=False, tracking_error=0.0, precision=precision, alpha_joint=100.0
    )
    safety, oracle = SafetyFilter(robot_model, config), SpeedOracle(robot_model)
    v_max = np.array([joint.velocity.value for joint in robot_model.joints])
    step = np.array([joint.acceleration.value for joint in robot_model.joints]) * robot_model.period
    possible = impossible = improved = 0
    for _ in range(150):
        q, jacobians, before = random_state(robot_model, oracle, limit, rng)
        if np.any(np.abs(before) > v_max):
            continue
        bounds = control_bounds(robot_model, before, np.zeros(robot_model.n), limits_jerk=False)
        least = least_share(jacobians, np.full(len(jacobians), limit), bounds)
        braking = speeds(jacobians, before * max(0.0, float((1.0 - step / np.abs(before)).max())))
        safety.reset(before)
        result = safety(q, before, rng.uniform(-1.0, 1.0, robot_model.n) * v_max, 0.0, 0.0)
        attained = speeds(jacobians, result.u)
        assert np.all(result.u >= bounds[0] - 1e-6)
        assert np.all(result.u <= bounds[1] + 1e-6)
        assert np.all(attained <= np.maximum(limit, 1.004 * braking + 2e-5))
        assert bool(result.flags & Reason.OVERSPEED) >= (attained.max() > limit)
        if least <= 1.0 - ROOM:
            possible += 1
            assert attained.max() <= limit
            assert not result.flags & Reason.OVERSPEED
        elif least > 1.0:
            impossible += 1
            assert result.flags & Reason.OVERSPEED
        improved += attained.max() < 0.99 * braking.max() and braking.max() > limit
    assert min(possible, impossible, improved) > 10
