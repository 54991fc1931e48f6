"""A mount that touches the floor: its distance does not change, and rounding must not count as an approach.

The importer's SO-101 has a first link whose collision spheres touch the table on which the arm is mounted.
"""

import msgspec
import numpy as np
import pytest

from dualbrain.core.geometry.shapes import Box, HalfSpace, Sphere
from dualbrain.records import Pose
from dualbrain.robots.loader import load_robot
from dualbrain.robots.model import CollisionSphere
from dualbrain.safety.cbf.filter import FilterStatus, Obstacle, SafetyFilter
from tests.safety import random_scenes

TABLE = Obstacle("table", HalfSpace(), Pose((0.0, 0.0, 0.0)))
SHOULDER_HEIGHT = 0.333
"""Height of the first chain frame of a Panda [m]."""


def robot_that_touches_the_table(depth=0.0, period=5e-3):
    """A Panda with one sphere on its first link, which touches the table or reaches `depth` [m] into it.

    As in most URDF files, the first axis is vertical only up to the decimals of the file.
    """
    panda = load_robot("panda")
    first = msgspec.structs.replace(panda.joints[0], quaternion=(1.0, 1.3e-6, -0.7e-6, 0.0))
    sphere = CollisionSphere("link1", (0.1, 0.05, 0.1 - SHOULDER_HEIGHT), 0.1 + depth)
    pairs = msgspec.structs.replace(panda.self_pairs, kept=())
    return msgspec.structs.replace(
        panda, joints=(first, *panda.joints[1:]), spheres=(sphere,), self_pairs=pairs, period=period
    )


def run(robot, obstacles, **settings):
    """Statuses of 2,000 steps with random wishes, from home, with exact tracking."""
    safety = SafetyFilter(robot, random_scenes.exact_config(**settings))
    safety.observe(obstacles)
    rng, q, seen = np.random.default_rng(0), np.array(robot.home), []
    v_max = np.array([joint.velocity.value for joint in robot.joints])
    for tick in range(2000):
        if tick % 60 == 0:
            wish = rng.uniform(-1.0, 1.0, 7) * v_max
        result = safety(q, np.zeros(7), wish)
        q = q + robot.period * result.u
        seen.append(result)
    return seen


@pytest.mark.parametrize("depth", [0.0, 1e-5, 2e-3])
@pytest.mark.parametrize("period", [1e-3, 5e-3, 1e-2])
@pytest.mark.parametrize("precision", ["float32", "float64"])
def test_a_mount_on_the_table_never_stops_the_arm(depth, period, precision):
    robot = robot_that_touches_the_table(depth, period)
    seen = run(robot, [TABLE], precision=precision)
    assert {result.status for result in seen} <= {FilterStatus.SAFE, FilterStatus.MODIFIED}
    assert all(result.certified for result in seen)
    assert max(abs(result.h_min + depth) for result in seen) < 1e-4


def test_a_first_link_that_moves_into_a_wall_is_still_not_certified():
    """The tolerance is for pairs that no joint can move; the distance to a wall depends on the first joint."""
    robot = robot_that_touches_the_table()
    safety = SafetyFilter(robot, random_scenes.exact_config())
    centre = safety.spheres(np.array(robot.home), 0.0)[0][0]
    along = np.array([-centre[1], centre[0], 0.0]) / np.hypot(centre[0], centre[1])
    wall = Obstacle("wall", Sphere(0.05), Pose(tuple(centre + 0.1495 * along)))
    safety.observe([wall])
    safety.reset(np.array([2.0, 0, 0, 0, 0, 0, 0]))
    result = safety(np.array(robot.home), np.zeros(7), np.zeros(7))
    assert result.status is FilterStatus.FAULT
    assert "link1 vs 'wall' goes from h = -" in result.explain()


def test_a_moving_obstacle_at_the_mount_still_stops():
    block = Obstacle("block", Box((0.3, 0.3, 0.01)), Pose((0.0, 0.0, 0.0)), static=False)
    seen = run(robot_that_touches_the_table(), [block])
    assert {result.status for result in seen} == {FilterStatus.STOPPED}
