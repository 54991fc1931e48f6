"""Scenes of the benchmark: a Panda on a table among fixed obstacles, a start, a goal, and a collision-free path."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from benchmarks.guards.path_planning import JointRange, edge_points, find_path
from dualbrain.robots.loader import load_robot
from dualbrain.robots.model import RobotModel
from dualbrain.safety.cbf.compiled._kernel import ReferenceDistance
from dualbrain.safety.cbf.obstacles import Obstacle
from dualbrain.simulation.plant.plant import Plant
from dualbrain.simulation.scenes.scene_spec import ObjectSpec, SceneSpec
from experiments.safety.random_scenes import random_obstacles
from experiments.safety.reference_judge import build_judge, true_h

Array = NDArray[np.float64]

MIN_OBSTACLES, MAX_OBSTACLES = 3, 5
PATH_CLEARANCE = (0.018, 0.008, 0.03)
"""Smallest distances of the planned path from obstacles, between own links [m], and from joint limits [rad]; distances
of several postures are measured up to 20 mm."""
GOAL_CLEARANCE = (0.05, 0.01, 0.1)
"""The same at start and goal."""
MIN_MOTION = 1.0
"""The goal is at least this far from the start in one joint [rad]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class GuardScene:
    """One scene: the obstacles with the table first, the joint angles `start` and `goal` (n,), and `path` (k, n)."""

    seed: int
    obstacles: tuple[Obstacle, ...]
    start: Array
    goal: Array
    path: Array

    def make_plant(self) -> Plant:
        """The plant at `start`, with its obstacles as fixed objects."""
        robot_model, _ = load_panda()
        objects = tuple(map(_fixed_object, self.obstacles[1:]))
        spec = SceneSpec(robot="panda", family="guards", seed=self.seed, objects=objects, places=())
        plant = Plant(spec, robot_model)
        plant.set_configuration(self.start)
        return plant


def make_scene(seed: int) -> GuardScene:
    """The scene of `seed`; obstacles and goals are drawn again until there is a path with the clearance.

    In scenes with an odd seed the straight way to the goal is not free.
    """
    robot_model, judge = load_panda()
    rng, start = np.random.default_rng([seed, 7]), np.array(robot_model.home)
    limits = joint_range(robot_model)
    while True:
        count = int(rng.integers(MIN_OBSTACLES, MAX_OBSTACLES + 1))
        obstacles = random_obstacles(judge, start, rng, count, GOAL_CLEARANCE[0])
        goal = rng.uniform(limits.lower, limits.upper)
        if np.abs(goal - start).max() < MIN_MOTION or not is_clear(judge, goal[None], obstacles, GOAL_CLEARANCE)[0]:
            continue
        if seed % 2 and is_clear(judge, edge_points(start, goal), obstacles, (0.0, 0.0, 0.0)).all():
            continue
        path = find_path(lambda q, found=obstacles: is_clear(judge, q, found, PATH_CLEARANCE), limits, start, goal, rng)
        if path is not None:
            return GuardScene(seed=seed, obstacles=tuple(obstacles), start=start, goal=goal, path=path)


def is_clear(
    judge: ReferenceDistance, q: Array, obstacles: Sequence[Obstacle], clearance: tuple[float, float, float]
) -> NDArray[np.bool_]:
    """Whether each of the postures q (t, n) keeps the `clearance` of obstacles, own links and joint limits."""
    return np.all(true_h(judge, q, obstacles)[:, [0, 2, 3]] >= clearance, axis=1)


def joint_range(robot_model: RobotModel) -> JointRange:
    """The joint limits of `robot_model`."""
    joints = robot_model.joints
    return JointRange(np.array([j.lower.value for j in joints]), np.array([j.upper.value for j in joints]))


@cache
def load_panda() -> tuple[RobotModel, ReferenceDistance]:
    """The Panda, and the reference distances of its spheres with the fingers open."""
    robot_model = load_robot("panda")
    return robot_model, build_judge(robot_model, float(robot_model.gripper.opening.value))


def _fixed_object(obstacle: Obstacle) -> ObjectSpec:
    return ObjectSpec(
        name=obstacle.name,
        role="obstacle",
        shape=obstacle.shape,
        position=obstacle.pose.position,
        quaternion=obstacle.pose.quaternion,
        mass=1.0,
        colour="grey",
        category="obstacle",
        fixed=True,
    )
