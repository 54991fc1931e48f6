"""joint_motion: velocity, acceleration and jerk of every joint stay within the limits of the actuators."""

from __future__ import annotations

import numpy as np

from dualbrain.safety.barriers.barrier import Array, BarrierSpec, Scenario
from dualbrain.safety.barriers.scenarios import home_posture, sparse_panda_filter


def _scenario() -> Scenario:
    safety = sparse_panda_filter()
    joints = safety.robot_model.joints
    v_max = np.array([joint.velocity.value for joint in joints])
    step = np.array([joint.acceleration.value for joint in joints]) * safety.robot_model.period
    last = np.zeros(safety.robot_model.n)
    ticks = 0

    def h(q: Array, u: Array) -> float:
        del q
        change = np.abs(u - last)
        last[:] = u
        return float(min(np.min(1.0 - np.abs(u) / v_max), np.min(1.0 - change / step)) + 1e-5)

    def push(q: Array) -> Array:
        nonlocal ticks
        del q
        ticks += 1
        return (3.0 if ticks // 200 % 2 else -3.0) * v_max

    return Scenario(safety=safety, start=home_posture(safety), nominal=push, h=h)


BARRIER = BarrierSpec(
    name="joint_motion",
    description="the velocity, the acceleration and optionally the jerk of every joint stay within the actuator limits",
    h="1 − |u|/v_max, 1 − |u − u_prev|/(a_max Δt), 1 − |u − 2u_prev + u_before|/(j_max Δt²)",
    row="max(−v, u_prev − a Δt) ≤ u ≤ min(v, u_prev + a Δt), narrowed by the jerk box if FilterConfig.jerk_limits",
    rank=None,
    alpha="none: a box on u",
    margins=(),
    source="RobotModel: velocity, acceleration and jerk bounds with their provenance",
    implementation="kernel/src/model/dbk_control_bounds.c",
    scenario=_scenario,
)
