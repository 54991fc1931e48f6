"""The two settings (many rows on a thin arm, many primitives around the whole arm), and the recorded states."""

from __future__ import annotations

import dataclasses

import numpy as np

from benchmarks.peers.problems.adversary import adversarial_nominal
from benchmarks.peers.problems.problem import (
    BOX,
    CAPSULE,
    SPHERE,
    Problem,
    barrier_rows,
    centres,
    control_bounds,
    distances,
)
from dualbrain.core.geometry.rotations import quaternion_to_matrix
from dualbrain.robots.loader import load_robot
from dualbrain.robots.model import RobotModel

ROW_COUNTS = (10, 50, 100, 400)
PRIMITIVE_COUNTS = (10, 100, 400)
THIN_ARM_LINKS = ("link3", "link4", "link5", "link6", "hand")
"""Links of the thin arm, with two spheres each: 10 robot spheres, N/10 spherical obstacles, N rows."""
CLEARANCE = {"rows": (0.03, 0.2), "primitives": (0.03, 0.6)}
"""Smallest and largest distance of an obstacle from the arm at home [m], small enough for active rows."""
RECORD_MARGIN = 1e-3
"""Margin of the recorded states [m]; larger than the margin of any filter, so that none starts in recovery."""


def thin_body() -> RobotModel:
    """Return the Panda with ten spheres and no self-collision pairs, so that all rows are obstacle rows."""
    import msgspec  # noqa: PLC0415

    robot_model = load_robot("panda")
    chosen = [s for link in THIN_ARM_LINKS for s in [s for s in robot_model.spheres if s.link == link][:2]]
    pairs = msgspec.structs.replace(robot_model.self_pairs, kept=())
    return msgspec.structs.replace(robot_model, spheres=tuple(chosen), self_pairs=pairs)


def rows_problem(n: int, seed: int = 0) -> Problem:
    """Return a problem with `n` rows: ten robot spheres and n/10 spherical obstacles of radius 4 cm near the arm."""
    empty = arm_problem(thin_body(), whole=False)
    rng = np.random.default_rng(seed)
    return with_obstacles(empty, place_obstacles(empty, rng, n // len(empty.sphere_frame), "rows", (SPHERE,)))


def primitives_problem(n: int, seed: int = 0) -> Problem:
    """Return a problem with all robot spheres and `n` obstacles: spheres, capsules and boxes in turn."""
    empty = arm_problem(load_robot("panda"), whole=True)
    obstacles = place_obstacles(empty, np.random.default_rng(seed), n, "primitives", (SPHERE, CAPSULE, BOX))
    return with_obstacles(empty, obstacles)


def arm_problem(robot_model: RobotModel, *, whole: bool) -> Problem:
    """Return chain, limits and spheres of a robot with closed fingers, without obstacles."""
    frame, centre, radius = [], [], []
    for link in robot_model.links:
        rotation, translation = quaternion_to_matrix(link.quaternion), np.array(link.translation)
        for sphere in robot_model.spheres:
            if sphere.link == link.name:
                frame.append(link.frame)
                centre.append(translation + rotation @ np.array(sphere.centre))
                radius.append(sphere.radius)
    joints = robot_model.joints
    return Problem(
        joint_rotation=np.array([quaternion_to_matrix(j.quaternion) for j in joints]),
        joint_offset=np.array([j.translation for j in joints], float),
        q_lower=np.array([j.lower.value for j in joints]),
        q_upper=np.array([j.upper.value for j in joints]),
        v_max=np.array([j.velocity.value for j in joints]),
        a_max=np.array([j.acceleration.value for j in joints]),
        home=np.array(robot_model.home),
        sphere_frame=np.array(frame),
        sphere_centre=np.array(centre),
        sphere_radius=np.array(radius),
        kind=np.zeros(0, int),
        position=np.zeros((0, 3)),
        rotation=np.zeros((0, 3, 3)),
        half=np.zeros((0, 3)),
        radius=np.zeros(0),
        alpha=robot_model.alpha,
        period=robot_model.period,
        whole_body=whole,
    )


ObstacleList = list[tuple[int, np.ndarray, np.ndarray, np.ndarray, float]]


def place_obstacles(
    problem: Problem, rng: np.random.Generator, count: int, setting: str, kinds: tuple[int, ...]
) -> ObstacleList:
    """Return `count` obstacles of the `kinds` in turn, at distances within CLEARANCE of the arm at home."""
    sphere_centres, (lowest, highest) = centres(problem, problem.home), CLEARANCE[setting]
    obstacles: ObstacleList = []
    while len(obstacles) < count:
        kind = kinds[len(obstacles) % len(kinds)]
        position = rng.uniform([0.1, -0.6, 0.05], [0.85, 0.6, 1.0])
        if kind == SPHERE:
            obstacle = (kind, position, np.eye(3), np.zeros(3), 0.04)
        elif kind == CAPSULE:
            obstacle = (kind, position, random_rotation(rng), np.array([0.0, 0.0, 0.06]), 0.025)
        else:
            obstacle = (kind, position, random_rotation(rng), rng.uniform(0.02, 0.05, 3), 0.0)
        d, _ = distances(with_obstacles(problem, [obstacle]), sphere_centres)
        if lowest < np.min(d[:, 0] - problem.sphere_radius) < highest:
            obstacles.append(obstacle)
    return obstacles


def random_rotation(rng: np.random.Generator) -> np.ndarray:
    """Return a random rotation (3, 3)."""
    matrix, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    return matrix if np.linalg.det(matrix) > 0.0 else -matrix


def with_obstacles(problem: Problem, obstacles: ObstacleList) -> Problem:
    """Return the same arm among `obstacles`."""
    kind, position, rotation, half, radius = zip(*obstacles, strict=True)
    return dataclasses.replace(
        problem,
        kind=np.array(kind),
        position=np.array(position),
        rotation=np.array(rotation),
        half=np.array(half),
        radius=np.array(radius),
    )


def record_states(problem: Problem, steps: int, seed: int = 0, hold: int = 40) -> tuple[np.ndarray, np.ndarray, float]:
    """Run a closed loop with the exact filter.

    Returns states (steps, n), nominal controls (steps, n), and the share of steps in which the filter changed the
    control. The nominal control changes every `hold` steps; it approaches one of the five nearest obstacles, or has a
    random direction.
    """
    from benchmarks.peers.problems.qp_oracle import exact_optimum  # noqa: PLC0415

    rng = np.random.default_rng(seed)
    q, u_nom = problem.home.copy(), np.zeros(problem.n)
    states, nominals, changed = np.empty((steps, problem.n)), np.empty((steps, problem.n)), 0
    for k in range(steps):
        A, b, h = barrier_rows(problem, q, margin=RECORD_MARGIN, near=0.4)
        if k % hold == 0:
            u_nom = adversarial_nominal(problem, A, h, rng, toward=0.5, slowest=0.02)
        u = exact_optimum(A, b, *control_bounds(problem, q), u_nom)
        states[k], nominals[k] = q, u_nom
        changed += bool(np.max(np.abs(u - u_nom)) > 1e-6)
        q = q + problem.period * u
    return states, nominals, changed / steps
