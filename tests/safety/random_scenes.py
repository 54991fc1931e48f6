"""Random static scenes around an arm, and closed loops in them."""

from dataclasses import dataclass

import numpy as np

from dualbrain.core.geometry.shapes import Box, Capsule, HalfSpace, Pose, Sphere
from dualbrain.safety.cbf.filter import FilterConfig, Obstacle, SafetyFilter
from tests.safety import geometry_oracle


def random_quaternion(rng):
    q = rng.normal(size=4)
    return tuple(q / np.linalg.norm(q))


def random_scene(body, rng, count=8, q=None, gap=0.01):
    """A table and `count` random obstacles that are at least `gap` [m] from the robot at posture `q`."""
    q = np.array(body.home) if q is None else q
    obstacles = [Obstacle("table", HalfSpace(), Pose((0.0, 0.0, 0.0)), known=True)]
    while len(obstacles) < count + 1:
        shape = rng.choice(3)
        if shape == 0:
            solid = Sphere(float(rng.uniform(0.02, 0.1)))
        elif shape == 1:
            solid = Capsule(float(rng.uniform(0.02, 0.06)), float(rng.uniform(0.02, 0.2)))
        else:
            solid = Box(tuple(rng.uniform(0.02, 0.15, 3)))
        reach, turn = rng.uniform(0.3, 0.85), rng.uniform(-np.pi, np.pi)
        place = (reach * np.cos(turn), reach * np.sin(turn), float(rng.uniform(0.0, 0.9)))
        obstacle = Obstacle(f"thing{len(obstacles)}", solid, Pose(place, random_quaternion(rng)))
        if geometry_oracle.h_obstacles(body, q[None], [obstacle])[0] > gap:
            obstacles.append(obstacle)
    return obstacles


@dataclass
class LoopResult:
    """Log of a closed loop: states after each step, controls, statuses, counts."""

    q: np.ndarray
    u: np.ndarray
    status: np.ndarray
    tally: dict


def closed_loop(safety: SafetyFilter, q0, steps, seed, *, hold=150, toward=0.7):
    """An adversary drives `safety` from rest at q0; q integrates exactly in float64."""
    n = safety.robot_model.n
    safety.reset()
    q, q_log, u_log = np.array(q0, float), np.empty((steps, n)), np.empty((steps, n))
    status = np.empty(steps, np.int8)
    tally = safety._kernel.closed_loop(q, seed, hold, toward, q_log, u_log, status)
    return LoopResult(q_log, u_log, status, tally)


def exact_config(**changes):
    """Filter configuration for loops that integrate ẏ = u exactly: no lag and no tracking error."""
    return FilterConfig(**({"lag_compensation": False, "tracking_error": 0.0} | changes))
