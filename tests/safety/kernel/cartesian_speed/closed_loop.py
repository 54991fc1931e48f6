"""Closed loops with a hostile nominal control, for the Cartesian speed limit, with ẏ = u and an independent oracle."""

from dataclasses import dataclass, field

import numpy as np

from dualbrain.core.geometry.shapes import Pose, Sphere
from dualbrain.robots.loader import load_robot
from dualbrain.safety.cbf.filter import FilterConfig, Obstacle, Rank, SafetyFilter
from dualbrain.safety.cbf.result import SPEED
from tests.safety.kernel.cartesian_speed.speed_oracle import SpeedOracle

HELD = np.array([[0.0, 0.0, 0.1, 0.03], [0.0, 0.06, 0.2, 0.03]])


@dataclass
class LoopReport:
    """Counts over the steps of a loop."""

    steps: int = 0
    above: int = 0
    worst: float = 0.0
    binding: int = 0
    overspeed: int = 0
    acceleration: float = 0.0
    jerk: float = 0.0
    statuses: dict = field(default_factory=dict)


def chaser(position, velocity):
    """A moving person as a sphere."""
    return Obstacle(
        name="person",
        shape=Sphere(0.1),
        pose=Pose(tuple(position.tolist())),
        velocity=tuple(velocity.tolist()),
        static=False,
        rank=Rank.BODY,
    )


def run_loop(robot, limit, steps, seed, *, limited=True, held=False, person=False, hold=80, **config):
    """Random full-speed nominal controls that change every `hold` steps; with `person`, a sphere chases the tool."""
    model, rng = load_robot(robot), np.random.default_rng(seed)
    chosen = FilterConfig(
        cartesian_speed=limit if limited else None, lag_compensation=False, tracking_error=0.0, **config
    )
    safety, oracle = SafetyFilter(model, chosen), SpeedOracle(model, HELD[:, :3] if held else ())
    if held:
        safety.attach(HELD, 0.0)
    v_max = np.array([joint.velocity.value for joint in model.joints])
    step = np.array([joint.acceleration.value for joint in model.joints]) * model.period
    jump = np.array([joint.jerk.value if joint.jerk else np.inf for joint in model.joints]) * model.period**2
    q, u, change, wanted, report = np.array(model.home), np.zeros(model.n), np.zeros(model.n), v_max, LoopReport()
    safety.reset(u)
    where = np.array([1.2, 0.0, 0.6])
    for k in range(steps):
        if k % hold == 0:
            wanted = v_max * rng.uniform(-1.0, 1.0, model.n) * rng.choice([0.3, 1.0, 3.0])
        if person:
            toward = safety.tool(q).position - where
            velocity = toward / max(np.linalg.norm(toward), 1e-9) * (0.8 if k % 1500 < 1000 else -0.8)
            if k % 20 == 0:
                safety.observe([chaser(where, velocity)], k * model.period)
            where = where + model.period * velocity
        result = safety(q, u, wanted, k * model.period, 0.0)
        fastest = float(oracle.speeds(q, result.u).max())
        report.steps += 1
        report.above += fastest > limit
        report.worst = max(report.worst, fastest)
        report.binding += any(row[0] == SPEED for row in result.binding_rows)
        report.overspeed += bool(result.flags & 8192)
        report.acceleration = max(report.acceleration, float((np.abs(result.u - u) / step).max()))
        report.jerk = max(report.jerk, float((np.abs(result.u - u - change) / jump).max()))
        report.statuses[result.status.name] = report.statuses.get(result.status.name, 0) + 1
        change, u = result.u - u, result.u
        q = q + model.period * u
    return report
