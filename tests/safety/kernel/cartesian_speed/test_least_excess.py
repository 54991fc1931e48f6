"""If no control keeps the speed limit with its reserve: the limit itself, then the least part of the excess."""

import msgspec
import numpy as np
import pytest
from scipy.optimize import linprog

from dualbrain.robots.loader import load_robot
from dualbrain.safety.cbf.filter import FilterConfig, SafetyFilter
from dualbrain.safety.stop_cause import Reason
from experiments.safety.speed_limits.least_share import control_bounds, least_share
from tests.safety.kernel.cartesian_speed.speed_oracle import SpeedOracle

ROOM = 0.0045
"""Share that the filter leaves for the approximation by cuts."""
ARMS = [("panda", 0.25), ("panda", 0.03), ("ur5e", 0.4)]


def speeds(jacobians, u):
    """Speeds (k,) [m/s] of the points at u."""
    return np.linalg.norm(jacobians @ u, axis=1)


class LimitedArm:
    """An arm with a speed limit, and random states of it for which the least share of the limit is known."""

    def __init__(self, robot, limit):
        robot_model = load_robot(robot)
        kept = msgspec.structs.replace(robot_model.self_pairs, kept=())
        self.robot_model, self.limit = msgspec.structs.replace(robot_model, self_pairs=kept), limit
        self.filters, self.oracle = [self._filter("float32"), self._filter("float64")], SpeedOracle(self.robot_model)
        self.v_max = np.array([joint.velocity.value for joint in self.robot_model.joints])
        self.step = np.array([joint.acceleration.value for joint in self.robot_model.joints]) * self.robot_model.period

    def _filter(self, precision):
        config = FilterConfig(
            cartesian_speed=self.limit,
            lag_compensation=False,
            tracking_error=0.0,
            precision=precision,
            alpha_joint=100.0,
        )
        return SafetyFilter(self.robot_model, config)

    def states(self, rng, least):
        """Postures, their Jacobians and controls before them, after which the least share of the limit is `least`."""
        for _ in range(8):
            q = np.array(self.robot_model.home) + rng.uniform(-0.4, 0.4, self.robot_model.n)
            jacobians, direction = self.oracle.jacobian(q), rng.standard_normal(self.robot_model.n)
            direction *= self.limit / speeds(jacobians, direction).max()
            low, high = 0.5, min(3.0, float((self.v_max / np.abs(direction)).min()))
            if self.least_share(jacobians, high * direction) < least:
                continue  # the joints are not fast enough
            for _ in range(11):
                middle = (low + high) / 2.0
                low, high = (middle, high) if self.least_share(jacobians, middle * direction) < least else (low, middle)
            yield q, jacobians, low * direction

    def bounds(self, before):
        """Bounds of the control after `before`."""
        return control_bounds(self.robot_model, before, np.zeros(self.robot_model.n), limits_jerk=False)

    def least_share(self, jacobians, before):
        """The least largest share of the limit after `before`."""
        return least_share(jacobians, np.full(len(jacobians), self.limit), self.bounds(before))

    def braking(self, jacobians, before):
        """Speeds (k,) [m/s] under braking along the direction of motion."""
        return speeds(jacobians, before * max(0.0, float((1.0 - self.step / np.abs(before)).max())))

    def filtered(self, q, before, rng):
        """The results of a step with a random nominal control, in both precisions."""
        nominal = rng.uniform(-1.0, 1.0, self.robot_model.n) * self.v_max
        for safety in self.filters:
            safety.reset(before)
            yield safety(q, before, nominal, 0.0, 0.0)


def least_excess(jacobians, base, step, bounds):
    """min e >= 0 so that |J_p u| <= base + e step_p for all p and a u within the bounds, by linear programs."""
    n, rows, limits = jacobians.shape[2], [], []
    u, e = np.mean(bounds, axis=0), 0.0
    for _ in range(200):
        velocities = jacobians @ u
        excess = np.linalg.norm(velocities, axis=1) - base - e * step
        if excess.max() <= 1e-6:
            break
        for p in np.argsort(-excess)[:8]:
            rows.append(np.append(velocities[p] / np.linalg.norm(velocities[p]) @ jacobians[p], -step[p]))
            limits.append(base)
        found = linprog(np.eye(n + 1)[n], A_ub=rows, b_ub=limits, bounds=[*zip(*bounds, strict=True), (0.0, None)])
        assert found.success
        u, e = found.x[:n], found.x[n]
    return e


@pytest.mark.parametrize(("robot", "limit"), ARMS)
@pytest.mark.parametrize("least", [0.8, 0.985, 0.994])
def test_a_limit_is_kept_if_a_control_keeps_it(robot, limit, least):
    arm, rng = LimitedArm(robot, limit), np.random.default_rng(17)
    braking_is_faster = 0
    for q, jacobians, before in arm.states(rng, least):
        for result in arm.filtered(q, before, rng):
            assert not result.flags & Reason.OVERSPEED
            assert speeds(jacobians, result.u).max() <= limit
        braking_is_faster += arm.braking(jacobians, before).max() > limit
    assert least < 0.9 or braking_is_faster > 2


@pytest.mark.parametrize(("robot", "limit"), ARMS)
@pytest.mark.parametrize("least", [1.003, 1.1])
def test_an_excess_is_reported_and_has_the_least_part_of_that_of_braking(robot, limit, least):
    arm, rng = LimitedArm(robot, limit), np.random.default_rng(18)
    improved = 0
    for q, jacobians, before in arm.states(rng, least):
        bounds, braking = arm.bounds(before), arm.braking(jacobians, before)
        base = limit * (1.0 - ROOM)
        step = np.maximum(braking - base, 0.0)
        allowed = np.maximum(limit, 1.004 * (base + least_excess(jacobians, base, step, bounds) * step) + 0.004 * limit)
        for result in arm.filtered(q, before, rng):
            attained = speeds(jacobians, result.u)
            assert result.flags & Reason.OVERSPEED
            assert np.all((result.u >= bounds[0] - 1e-6) & (result.u <= bounds[1] + 1e-6))
            assert np.all(attained <= np.maximum(limit, 1.004 * braking + 2e-5))
            assert np.all(attained <= allowed)
        improved += allowed.max() < 0.99 * braking.max()
    assert improved > 0
