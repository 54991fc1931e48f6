"""Monte Carlo of the Cartesian speed limit: compiled loops with an adversarial nominal control among obstacles."""

import numpy as np
import pytest

from dualbrain.core.geometry.rotations import quaternion_to_matrix
from dualbrain.robots.loader import load_robot
from dualbrain.safety.cbf.filter import SafetyFilter
from tests.safety import random_scenes
from tests.safety.kernel.cartesian_speed.speed_oracle import SpeedOracle

BATCH = 2000


def many_points(oracle, Q):
    """Positions (m, k, 3) of all points at the configurations Q (m, n) of a robot with revolute joints."""
    turn, origin = np.broadcast_to(np.eye(3), (len(Q), 3, 3)), np.zeros((len(Q), 3))
    frames = [(turn, origin)]
    for k, joint in enumerate(oracle.model.joints):
        origin = origin + turn @ np.array(joint.translation)
        spin = np.zeros((len(Q), 3, 3))
        spin[:, 0, 0] = spin[:, 1, 1] = np.cos(Q[:, k])
        spin[:, 1, 0] = np.sin(Q[:, k])
        spin[:, 0, 1] = -spin[:, 1, 0]
        spin[:, 2, 2] = 1.0
        turn = turn @ quaternion_to_matrix(joint.quaternion) @ spin
        frames.append((turn, origin))
    return np.stack([frames[f][1] + frames[f][0] @ p for f, p, _ in oracle.local_points], axis=1)


def largest_speeds(oracle, Q, U):
    """Largest speed (m,) of a point at each state, by central differences."""
    step, found = 1e-5, []
    for first in range(0, len(Q), BATCH):
        q, u = Q[first : first + BATCH], U[first : first + BATCH]
        moved = many_points(oracle, q + step * u) - many_points(oracle, q - step * u)
        found.append(np.linalg.norm(moved, axis=2).max(axis=1) / (2.0 * step))
    return np.concatenate(found)


def count_above(robot, limit, steps, seed, *, limited=True):
    """Steps above the limit, the largest speed, and the counts by status."""
    model = load_robot(robot)
    config = random_scenes.exact_config(cartesian_speed=limit if limited else None)
    safety, oracle = SafetyFilter(model, config), SpeedOracle(model)
    safety.observe(random_scenes.random_scene(model, np.random.default_rng(seed)))
    loop = random_scenes.closed_loop(safety, model.home, steps, seed)
    speeds = largest_speeds(oracle, np.vstack([model.home, loop.q[:-1]]), loop.u)
    return int((speeds > limit).sum()), float(speeds.max()), loop.tally


@pytest.mark.parametrize("robot", ["panda", "ur5e"])
def test_no_step_of_a_compiled_loop_is_above_the_limit(robot):
    for seed in range(2):
        above, largest, counts = count_above(robot, 0.3, 10000, seed)
        assert above == 0, largest
        assert largest > 0.29
        assert counts["stopped"] == 0
        assert counts["modified"] > 5000


@pytest.mark.parametrize("robot", ["panda", "ur5e"])
def test_the_same_loop_without_the_limit_is_above_it(robot):
    above, largest, _ = count_above(robot, 0.3, 5000, 0, limited=False)
    assert above > 1000
    assert largest > 1.0


@pytest.mark.slow
@pytest.mark.parametrize("robot", ["panda", "ur5e"])
@pytest.mark.parametrize("limit", [0.05, 0.25, 0.4])
def test_no_step_of_many_is_above_the_limit(robot, limit):
    for seed in range(10):
        assert count_above(robot, limit, 100_000, seed)[0] == 0
