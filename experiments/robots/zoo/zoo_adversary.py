"""A closed loop with any robot and an adversarial nominal control, judged in float64 independently of the kernel.

The loop works for arms with prismatic joints and for mobile bases alike: it computes the poses of the spheres from the
robot model in NumPy, exact distances to shapes, and integrates q exactly.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dualbrain.core.geometry.distance import signed_distance
from dualbrain.core.geometry.shapes import Box, Capsule, Pose, Sphere
from dualbrain.robots.collision_model.self_collision import chain_frames, sphere_centres
from dualbrain.robots.differential_drive import integrate_configuration
from dualbrain.robots.model import RobotModel
from dualbrain.safety.barriers.scenarios import EXACT_TRACKING
from dualbrain.safety.cbf.filter import FilterStatus, Obstacle, SafetyFilter

Array = NDArray[np.float64]
HOLD_STEPS = (20, 100, 300)
"""Numbers of steps for which a nominal control is held."""
START_CLEARANCE_SHARE = 0.03
"""Least distance of obstacles from the start posture, as a share of the reach."""


@dataclass(frozen=True, slots=True, kw_only=True)
class AttackResult:
    """Steps by filter status; smallest true h: obstacles, own links [m], joint limits [rad, m]; steps with h < 0."""

    status: tuple[int, ...]
    h_obstacles: float
    h_self: float
    h_joint: float
    n_below_zero: int


class DistanceChecker:
    """True h of one robot among obstacles at any posture."""

    def __init__(self, robot_model: RobotModel) -> None:
        """Collect the spheres by link; the distance of links fixed to the world to obstacles does not count."""
        self.robot_model = robot_model
        self.mobile = robot_model.base == "differential"
        self.links = [
            link for link in robot_model.links if any(sphere.link == link.name for sphere in robot_model.spheres)
        ]
        self.centres = {
            link.name: np.array([sphere.centre for sphere in robot_model.spheres if sphere.link == link.name])
            for link in self.links
        }
        self.radii = {
            link.name: np.array([sphere.radius for sphere in robot_model.spheres if sphere.link == link.name])
            for link in self.links
        }
        self.low = np.array([joint.lower.value for joint in robot_model.joints])
        self.high = np.array([joint.upper.value for joint in robot_model.joints])

    def sphere_centres(self, q: Array) -> dict[str, Array]:
        """Centres (m, k, 3) [m] of every link's spheres at m configurations q (m, n); mobile robots: (m, n + 1)."""
        chain = np.hstack([np.zeros((len(q), 2)), q[:, 3:]]) if self.mobile else q
        turns, origins = chain_frames(self.robot_model.joints, chain)
        found = {link.name: sphere_centres(link, self.centres[link.name], turns, origins, 0.0) for link in self.links}
        if self.mobile:
            c, s, zero = np.cos(q[:, 2]), np.sin(q[:, 2]), np.zeros(len(q))
            turn = np.stack([c, -s, zero, s, c, zero, zero, zero, zero + 1.0], axis=1).reshape(-1, 3, 3)
            position = np.column_stack([q[:, :2], zero])
            found = {name: centres @ turn.transpose(0, 2, 1) + position[:, None] for name, centres in found.items()}
        return found

    def obstacle_distance(self, centres: dict[str, Array], obstacles: list[Obstacle]) -> Array:
        """Smallest distance (m,) [m] of any moving sphere to any obstacle; `centres` as from `sphere_centres`."""
        least = np.full(len(next(iter(centres.values()))), np.inf)
        for link in self.links:
            if link.frame > 0:
                for obstacle in obstacles:
                    distance = signed_distance(obstacle.shape, obstacle.pose, centres[link.name])
                    least = np.minimum(least, (distance - self.radii[link.name]).min(axis=1))
        return least

    def self_distance(self, centres: dict[str, Array]) -> Array:
        """Smallest gap (m,) [m] of all self-collision pairs; `centres` as from `sphere_centres`."""
        least = np.full(len(next(iter(centres.values()))), np.inf)
        for a, b in self.robot_model.self_pairs.kept:
            for k in range(centres[a].shape[1]):
                gap = np.linalg.norm(centres[b] - centres[a][:, k, None], axis=2) - self.radii[b] - self.radii[a][k]
                least = np.minimum(least, gap.min(axis=1))
        return least

    def joint_limit_distance(self, q: Array) -> Array:
        """Smallest distance (m,) [rad or m] to a joint limit; infinite for a base without joints."""
        joints, low, high = (q[:, 3:], self.low[2:], self.high[2:]) if self.mobile else (q, self.low, self.high)
        return np.min(np.minimum(joints - low, high - joints), axis=1, initial=np.inf)

    def min_h(self, q: Array, obstacles: list[Obstacle]) -> Array:
        """Smallest h (m,) [m] of obstacles and own links."""
        centres = self.sphere_centres(q)
        return np.minimum(self.obstacle_distance(centres, obstacles), self.self_distance(centres))


def run_attack(robot_model: RobotModel, seed: int, steps: int) -> AttackResult:
    """`steps` steps of an adversary in one random scene around the robot at its home posture."""
    rng, judge = np.random.default_rng(seed), DistanceChecker(robot_model)
    q = np.array(robot_model.home, float)
    obstacles = _random_obstacles(judge, q, rng, 10)
    safety = SafetyFilter(robot_model, EXACT_TRACKING)
    safety.observe(obstacles)
    v_max = np.array([joint.velocity.value for joint in robot_model.joints])
    u, hold, u_nom = np.zeros(robot_model.n), 0, np.zeros(robot_model.n)
    path, counts = np.empty((steps, len(q))), [0] * len(FilterStatus)
    for step in range(steps):
        if hold == 0:
            hold = int(rng.choice(HOLD_STEPS))
            u_nom = (
                _worst_control(judge, q, obstacles, v_max)
                if rng.random() < 0.7
                else rng.choice([-1.5, 1.5], robot_model.n) * v_max
            )
        hold -= 1
        result = safety(q, u, u_nom)
        u = result.u
        counts[result.status] += 1
        q = integrate_configuration(q, u, robot_model.period) if judge.mobile else q + robot_model.period * u
        path[step] = q
    return _evaluate_path(judge, path, obstacles, tuple(counts))


def _evaluate_path(
    judge: DistanceChecker, path: Array, obstacles: list[Obstacle], counts: tuple[int, ...]
) -> AttackResult:
    obstacle = own = joint = np.inf
    below = 0
    for q in np.array_split(path, max(1, len(path) // 2000)):
        centres = judge.sphere_centres(q)
        h_obstacles, h_self = judge.obstacle_distance(centres, obstacles), judge.self_distance(centres)
        h_joint = judge.joint_limit_distance(q)
        obstacle, own, joint = min(obstacle, h_obstacles.min()), min(own, h_self.min()), min(joint, h_joint.min())
        below += int(np.sum(np.minimum(np.minimum(h_obstacles, h_self), h_joint) < 0.0))
    return AttackResult(
        status=counts, h_obstacles=float(obstacle), h_self=float(own), h_joint=float(joint), n_below_zero=below
    )


def _worst_control(judge: DistanceChecker, q: Array, obstacles: list[Obstacle], v_max: Array) -> Array:
    """Full speed against the gradient of the smallest h, which finite differences give."""
    step = 1e-4
    postures = [q]
    for k in range(len(v_max)):
        u = np.zeros(len(v_max))
        u[k] = 1.0
        postures.append(integrate_configuration(q, u, step) if judge.mobile else q + step * u)
    h = judge.min_h(np.array(postures), obstacles)
    return -1.5 * v_max * np.sign(h[1:] - h[0])


def _random_obstacles(judge: DistanceChecker, q: Array, rng: np.random.Generator, count: int) -> list[Obstacle]:
    """Spheres, capsules and boxes around the robot, sized by its reach, at a distance from the start posture."""
    start = np.concatenate([centres[0] for centres in judge.sphere_centres(q[None]).values()])
    middle, reach = start.mean(axis=0), _reach(judge, q, rng)
    found: list[Obstacle] = []
    while len(found) < count:
        size = reach * rng.uniform(0.03, 0.12)
        shape = (Sphere(size), Capsule(0.5 * size, size), Box((size, float(rng.uniform(0.3, 1.0)) * size, 0.5 * size)))
        turn = rng.normal(size=4)
        w, x, y, z = (float(value) for value in turn / np.linalg.norm(turn))
        away = rng.normal(size=3) * (
            1.0,
            1.0,
            0.1 if judge.mobile and not judge.robot_model.is_mobile_manipulator else 0.7,
        )
        place = middle + rng.uniform(0.3, 1.0) * reach * away / np.linalg.norm(away)
        pose = Pose((float(place[0]), float(place[1]), float(place[2])), (w, x, y, z))
        obstacle = Obstacle(f"obstacle{len(found)}", shape[int(rng.integers(3))], pose)
        if judge.obstacle_distance(judge.sphere_centres(q[None]), [obstacle])[0] > START_CLEARANCE_SHARE * reach:
            found.append(obstacle)
    return found


def _reach(judge: DistanceChecker, q: Array, rng: np.random.Generator) -> float:
    """The largest distance of a sphere from the first joint [m]; for a mobile robot, the distance that it may drive."""
    if judge.mobile:
        return 1.5 if judge.robot_model.is_mobile_manipulator else 3.0
    low, high = np.maximum(judge.low, -np.pi), np.minimum(judge.high, np.pi)
    postures = np.vstack([q, low + (high - low) * rng.random((200, len(low)))])
    _, origins = chain_frames(judge.robot_model.joints, postures)
    offsets = [centres - origins[:, 1, None] for centres in judge.sphere_centres(postures).values()]
    return float(max(np.linalg.norm(one, axis=2).max() for one in offsets))
