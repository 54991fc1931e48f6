"""The least possible largest share of the speed limits in one step, by linear programs in float64."""

from __future__ import annotations

import numpy as np
from scipy.optimize import linprog

from dualbrain.robots.model import RobotModel
from experiments.safety.speed_limits.point_speeds import Array

PARTS_PER_ROUND, ROUNDS = 8, 100
TOLERANCE = 1e-6


def least_share(jacobians: Array, limits: Array, bounds: tuple[Array, Array]) -> float:
    """The least over u within `bounds` of max_p |J_p u| / v_p, for Jacobians (k, 3, n) and limits (k,) [m/s].

    Each round adds n_p'J_p u ≤ t v_p with n_p the direction of J_p u for the fastest parts. The result is a lower bound
    that is exact up to `TOLERANCE`, or the best one after `ROUNDS`.
    """
    n, lower, upper = jacobians.shape[2], *bounds
    box = [*zip(lower, upper, strict=True), (0.0, None)]
    u, share, rows = (lower + upper) / 2.0, 0.0, list[Array]()
    for _ in range(ROUNDS):
        velocities = jacobians @ u
        speeds = np.linalg.norm(velocities, axis=1)
        if (speeds / limits).max() <= share + TOLERANCE:
            break
        for p in np.argsort(-speeds / limits)[:PARTS_PER_ROUND]:
            rows.append(np.append(velocities[p] / max(speeds[p], 1e-12) @ jacobians[p] / limits[p], -1.0))
        found = linprog(np.eye(n + 1)[n], A_ub=np.array(rows), b_ub=np.zeros(len(rows)), bounds=box, method="highs")
        u, share = found.x[:n], float(found.x[n])
    return share


def control_bounds(robot_model: RobotModel, before: Array, change: Array, *, limits_jerk: bool) -> tuple[Array, Array]:
    """Bounds (n,) of the control after `before` (n,), which changed by `change` in the last step.

    They follow from the limits of speed, acceleration and jerk. The position limits are left out, so the share within
    these bounds is at most the one that the filter can reach.
    """
    period, joints = robot_model.period, robot_model.joints
    v_max = np.array([joint.velocity.value for joint in joints])
    step = np.array([joint.acceleration.value for joint in joints]) * period
    lower, upper = np.maximum(before - step, -v_max), np.minimum(before + step, v_max)
    if limits_jerk:
        jump = np.array([joint.jerk.value if joint.jerk else np.inf for joint in joints]) * period**2
        lower, upper = np.maximum(lower, before + change - jump), np.minimum(upper, before + change + jump)
    return lower, upper
