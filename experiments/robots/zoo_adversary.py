"""A closed loop against any body: a nominal control that seeks the worst, judged in float64 apart from the kernel.

Only what every body has is used, so that arms with slides and bases are driven alike: poses of the spheres from the
body's own data in numpy, exact distances to solids, q integrated exactly.
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
"""Steps for which the nominal control is kept."""
START_CLEARANCE_SHARE = 0.03
"""Share of the reach that obstacles keep from the start posture."""


@dataclass(frozen=True, slots=True)
class AttackResult:
    """Steps by status, least true h of things and own parts [m] and of joint limits [rad or m], steps with h < 0."""

    status: tuple[int, ...]
    h_obstacles: float
    h_self: float
    h_joint: float
    n_below_zero: int


class DistanceChecker:
    """True h of one body among solids at any posture."""

    def __init__(self, robot_model: RobotModel) -> None:
        """Collect spheres by link; those bolted to the world make no h with things."""
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
        """Centres (m, k, 3) of every link's spheres at configurations q (m, n), of what drives (m, n + 1)."""
        chain = np.hstack([np.zeros((len(q), 2)), q[:, 3:]]) if self.mobile else q
        turns, origins = chain_frames(self.robot_model.joints, chain)
        found = {link.name: sphere_centres(link, self.centres[link.name], turns, origins, 0.0) for link in self.links}
        if self.mobile:
            c, s, zero = np.cos(q[:, 2]), np.sin(q[:, 2]), np.zeros(len(q))
            turn = np.stack([c, -s, zero, s, c, zero, zero, zero, zero + 1.0], axis=1).reshape(-1, 3, 3)
            at = np.column_stack([q[:, :2], zero])
            found = {name: centres @ turn.transpose(0, 2, 1) + at[:, None] for name, centres in found.items()}
        return found

    def obstacle_distance(self, placed: dict[str, Array], obstacles: list[Obstacle]) -> Array:
        """Least distance (m,) of any moving sphere to any obstacle."""
        least = np.full(len(next(iter(placed.values()))), np.inf)
        for link in self.links:
            if link.frame > 0:
                for thing in obstacles:
                    away = signed_distance(thing.shape, thing.pose, placed[link.name]) - self.radii[link.name]
                    least = np.minimum(least, away.min(axis=1))
        return least

    def self_distance(self, placed: dict[str, Array]) -> Array:
        """Least gap (m,) of all kept pairs."""
        least = np.full(len(next(iter(placed.values()))), np.inf)
        for a, b in self.robot_model.self_pairs.kept:
            for k in range(placed[a].shape[1]):
                gap = np.linalg.norm(placed[b] - placed[a][:, k, None], axis=2) - self.radii[b] - self.radii[a][k]
                least = np.minimum(least, gap.min(axis=1))
        return least

    def joint_limit_distance(self, q: Array) -> Array:
        """Least room (m,) to a joint's end; a base has none."""
        joints, low, high = (q[:, 3:], self.low[2:], self.high[2:]) if self.mobile else (q, self.low, self.high)
        return np.min(np.minimum(joints - low, high - joints), axis=1, initial=np.inf)

    def min_h(self, q: Array, obstacles: list[Obstacle]) -> Array:
        """Least h (m,) of things and own parts."""
        placed = self.sphere_centres(q)
        return np.minimum(self.obstacle_distance(placed, obstacles), self.self_distance(placed))


def run_attack(robot_model: RobotModel, seed: int, steps: int) -> AttackResult:
    """One random scene around `body` at home, `steps` steps of an adversary."""
    rng, judge = np.random.default_rng(seed), DistanceChecker(robot_model)
    q = np.array(robot_model.home, float)
    obstacles = _random_obstacles(judge, q, rng, 10)
    safety = SafetyFilter(robot_model, EXACT_TRACKING)
    safety.observe(obstacles)
    v_max = np.array([joint.velocity.value for joint in robot_model.joints])
    u, hold, wish = np.zeros(robot_model.n), 0, np.zeros(robot_model.n)
    path, counts = np.empty((steps, len(q))), [0] * len(FilterStatus)
    for step in range(steps):
        if hold == 0:
            hold = int(rng.choice(HOLD_STEPS))
            wish = (
                _worst_control(judge, q, obstacles, v_max)
                if rng.random() < 0.7
                else rng.choice([-1.5, 1.5], robot_model.n) * v_max
            )
        hold -= 1
        answer = safety(q, u, wish)
        u = answer.u
        counts[answer.status] += 1
        q = integrate_configuration(q, u, robot_model.period) if judge.mobile else q + robot_model.period * u
        path[step] = q
    return _evaluate_path(judge, path, obstacles, tuple(counts))


def _evaluate_path(
    judge: DistanceChecker, path: Array, obstacles: list[Obstacle], counts: tuple[int, ...]
) -> AttackResult:
    things = own = joint = np.inf
    below = 0
    for q in np.array_split(path, max(1, len(path) // 2000)):
        placed = judge.sphere_centres(q)
        h_things, h_self = judge.obstacle_distance(placed, obstacles), judge.self_distance(placed)
        h_joint = judge.joint_limit_distance(q)
        things, own, joint = min(things, h_things.min()), min(own, h_self.min()), min(joint, h_joint.min())
        below += int(np.sum(np.minimum(np.minimum(h_things, h_self), h_joint) < 0.0))
    return AttackResult(counts, float(things), float(own), float(joint), below)


def _worst_control(judge: DistanceChecker, q: Array, obstacles: list[Obstacle], v_max: Array) -> Array:
    """Full speed down the gradient of the least h, by differences."""
    step = 1e-4
    tries = [q]
    for k in range(len(v_max)):
        u = np.zeros(len(v_max))
        u[k] = 1.0
        tries.append(integrate_configuration(q, u, step) if judge.mobile else q + step * u)
    h = judge.min_h(np.array(tries), obstacles)
    return -1.5 * v_max * np.sign(h[1:] - h[0])


def _random_obstacles(judge: DistanceChecker, q: Array, rng: np.random.Generator, count: int) -> list[Obstacle]:
    """Balls, capsules and boxes around the robot, sized by its reach, none of them near at the start."""
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
        thing = Obstacle(
            f"thing{len(found)}", shape[int(rng.integers(3))], Pose(tuple(map(float, place)), (w, x, y, z))
        )
        if judge.obstacle_distance(judge.sphere_centres(q[None]), [thing])[0] > START_CLEARANCE_SHARE * reach:
            found.append(thing)
    return found


def _reach(judge: DistanceChecker, q: Array, rng: np.random.Generator) -> float:
    """How far any sphere comes from the first joint [m]; of a base, how far it should drive."""
    if judge.mobile:
        return 1.5 if judge.robot_model.is_mobile_manipulator else 3.0
    low, high = np.maximum(judge.low, -np.pi), np.minimum(judge.high, np.pi)
    tries = np.vstack([q, low + (high - low) * rng.random((200, len(low)))])
    turns, origins = chain_frames(judge.robot_model.joints, tries)
    del turns
    far = [centres - origins[:, 1, None] for name, centres in judge.sphere_centres(tries).items()]
    return float(max(np.linalg.norm(one, axis=2).max() for one in far))
