"""Random scenes around an arm, and random start postures."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dualbrain.core.geometry.shapes import Box, Capsule, HalfSpace, Pose, Sphere, Vector
from dualbrain.robots.model import RobotModel
from dualbrain.safety.cbf.compiled._kernel import ReferenceDistance
from dualbrain.safety.cbf.obstacles import Obstacle
from experiments.safety.reference_judge import true_h

Array = NDArray[np.float64]
TABLE = Obstacle(name="table", shape=HalfSpace(), pose=Pose((0.0, 0.0, 0.0)))


def random_posture(
    robot_model: RobotModel, judge: ReferenceDistance, rng: np.random.Generator, gap: float = 0.05
) -> Array:
    """Joint angles (n,) [rad] at least `gap` [m, rad] from own links, table and joint limits; home if none is found."""
    low = np.array([joint.lower.value for joint in robot_model.joints])
    high = np.array([joint.upper.value for joint in robot_model.joints])
    for _ in range(60):
        q = rng.uniform(low + 0.2, high - 0.2)
        if np.min(true_h(judge, q[None], [TABLE])[0, :4]) > gap:
            return q
    return np.array(robot_model.home)


def random_obstacles(
    judge: ReferenceDistance, q: Array, rng: np.random.Generator, count: int, gap: float = 0.05
) -> list[Obstacle]:
    """The table and `count` obstacles of all shapes within reach, each at least `gap` [m] from the arm at `q` (n,)."""
    found = [TABLE]
    while len(found) <= count:
        obstacle = Obstacle(
            name=f"thing{len(found)}",
            shape=_random_shape(rng),
            pose=Pose(_random_position(rng), _random_quaternion(rng)),
        )
        if true_h(judge, q[None], [obstacle])[0, 0] > gap:
            found.append(obstacle)
    return found


def random_moving_obstacle(judge: ReferenceDistance, q: Array, rng: np.random.Generator, gap: float = 0.25) -> Obstacle:
    """A sphere or a capsule like a human arm, at rest at least `gap` [m] from the arm, which will move."""
    while True:
        radius = float(rng.uniform(0.03, 0.07))
        shape = Sphere(radius) if rng.random() < 0.5 else Capsule(radius, float(rng.uniform(0.05, 0.2)))
        obstacle = Obstacle(
            name="mover", shape=shape, pose=Pose(_random_position(rng), _random_quaternion(rng)), static=False
        )
        if true_h(judge, q[None], [obstacle])[0, 1] > gap:
            return obstacle


def _random_shape(rng: np.random.Generator) -> Sphere | Capsule | Box:
    match int(rng.integers(3)):
        case 0:
            return Sphere(float(rng.uniform(0.02, 0.1)))
        case 1:
            return Capsule(float(rng.uniform(0.02, 0.06)), float(rng.uniform(0.02, 0.2)))
        case _:
            x, y, z = rng.uniform(0.02, 0.15, 3)
            return Box((float(x), float(y), float(z)))


def _random_position(rng: np.random.Generator) -> Vector:
    reach, turn = rng.uniform(0.3, 0.85), rng.uniform(-np.pi, np.pi)
    return (float(reach * np.cos(turn)), float(reach * np.sin(turn)), float(rng.uniform(0.0, 0.9)))


def _random_quaternion(rng: np.random.Generator) -> tuple[float, float, float, float]:
    w, x, y, z = (q := rng.normal(size=4)) / np.linalg.norm(q)
    return (float(w), float(x), float(y), float(z))
