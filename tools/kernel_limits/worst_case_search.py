"""Adversarial closed loops, and a search for the step with the most QP iterations, rows and processor time."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dualbrain.core.geometry.shapes import Box, Capsule, HalfSpace, Pose, Sphere
from dualbrain.robots.loader import load_robot
from dualbrain.robots.model import RobotModel
from dualbrain.safety.cbf.compiled import _kernel
from dualbrain.safety.cbf.filter import FilterConfig, Obstacle, SafetyFilter

Array = NDArray[np.float64]
OBSTACLE_COUNTS = (8, 20, 47)
"""Numbers of obstacles around the arm, without the table."""


@dataclass(slots=True, kw_only=True)
class StepCase:
    """Inputs of one step (joint positions, previous and nominal control), and its iterations, rows and time [s]."""

    scene: int
    q: Array
    u_prev: Array
    u_nom: Array
    iterations: int
    rows: int
    seconds: float


def random_obstacles(rng: np.random.Generator, count: int, *, moving: bool) -> list[Obstacle]:
    """Return a table and `count` spheres, capsules and boxes in the workspace of the arm; they may touch it."""
    obstacles = [Obstacle("table", HalfSpace(), Pose((0.0, 0.0, 0.0)), known=True)]
    for k in range(count):
        azimuth, reach = rng.uniform(-np.pi, np.pi), rng.uniform(0.3, 0.85)
        quaternion = rng.normal(size=4)
        pose = Pose(
            (float(reach * np.cos(azimuth)), float(reach * np.sin(azimuth)), float(rng.uniform(0.05, 0.9))),
            tuple((quaternion / np.linalg.norm(quaternion)).tolist()),
        )
        size = rng.uniform(0.02, 0.08, 3).tolist()
        shape = (Sphere(size[0]), Capsule(size[0], size[1]), Box(tuple(size)))[int(rng.integers(3))]
        velocity = tuple(rng.uniform(-0.2, 0.2, 3).tolist()) if moving else (0.0, 0.0, 0.0)
        obstacles.append(Obstacle(f"o{k}", shape, pose, velocity=velocity, static=not moving))
    return obstacles


def make_filter(robot_model: RobotModel, seed: int) -> SafetyFilter:
    """Return a filter with default configuration in scene `seed`."""
    rng = np.random.default_rng(seed)
    count, moving = OBSTACLE_COUNTS[seed % len(OBSTACLE_COUNTS)], seed % 2 == 1
    safety = SafetyFilter(robot_model, FilterConfig())
    safety.observe(random_obstacles(rng, count, moving=moving), 0.0)
    return safety


def adversarial_loop(robot_model: RobotModel, seed: int, steps: int) -> Iterator[StepCase]:
    """Run a closed loop with random extreme controls, or controls that decrease the smallest h.

    A second filter computes the same inputs in C for the time measurement. Obstacles keep their positions during the
    loop (their velocities enter the rows), so that both filters have the same inputs in every step.
    """
    safety, twin, rng = (
        make_filter(robot_model, seed),
        make_filter(robot_model, seed),
        np.random.default_rng(seed + 10_000),
    )
    v_max = np.array([joint.velocity.value for joint in robot_model.joints])
    q, u_nom, u_prev = np.array(robot_model.home), np.zeros(robot_model.n), np.zeros(robot_model.n)
    rest, hold = np.zeros(robot_model.n), (20, 150, 400)[seed % 3]
    for step in range(steps):
        if step % hold == 0:
            u_nom = v_max * rng.choice([-1.0, 1.0], robot_model.n)
            rows = safety.rows() if rng.random() < 0.7 else ()
            if rows:
                u_nom = -v_max * np.sign(min(rows, key=lambda row: row.h).a)
        if step % 2000 == 0:
            q = np.array(robot_model.home) + rng.uniform(-0.3, 0.3, robot_model.n)
        result = safety(q, rest, u_nom)
        seconds = twin._kernel.time_steps(q[None], u_nom[None], False)
        yield StepCase(
            scene=seed,
            q=q.copy(),
            u_prev=u_prev.copy(),
            u_nom=u_nom.copy(),
            iterations=result.iterations,
            rows=result.n_rows,
            seconds=seconds,
        )
        u_prev = result.u
        q = q + robot_model.period * result.u


def repeat_cold(safety: SafetyFilter, m: StepCase, *, times: int = 1) -> StepCase:
    """Repeat a step without a warm start; returns the smallest of `times` measured times."""
    rest, seconds = np.zeros(len(m.q)), np.inf
    safety.reset(m.u_prev)
    result = safety(m.q, rest, m.u_nom)
    for _ in range(times):
        safety.reset(m.u_prev)
        seconds = min(seconds, safety._kernel.time_steps(m.q[None], m.u_nom[None], True))
    return StepCase(
        scene=m.scene,
        q=m.q,
        u_prev=m.u_prev,
        u_nom=m.u_nom,
        iterations=result.iterations,
        rows=result.n_rows,
        seconds=seconds,
    )


def search_worst_step(robot_model: RobotModel, start: list[StepCase], rng: np.random.Generator, tries: int) -> StepCase:
    """Search by random changes of posture and controls that increase the iterations (then the rows)."""
    v_max = np.array([joint.velocity.value for joint in robot_model.joints])
    best: StepCase | None = None
    for first in start:
        safety = make_filter(robot_model, first.scene)
        current = repeat_cold(safety, first)
        for k in range(tries):
            size = (0.3, 0.1, 0.02)[k % 3]
            candidate = repeat_cold(
                safety,
                StepCase(
                    scene=first.scene,
                    q=current.q + size * rng.normal(size=robot_model.n),
                    u_prev=np.clip(current.u_prev + size * v_max * rng.normal(size=robot_model.n), -v_max, v_max),
                    u_nom=np.clip(current.u_nom + size * v_max * rng.normal(size=robot_model.n), -v_max, v_max),
                    iterations=0,
                    rows=0,
                    seconds=0.0,
                ),
            )
            if (candidate.iterations, candidate.rows) >= (current.iterations, current.rows):
                current = candidate
        if best is None or (current.iterations, current.rows) > (best.iterations, best.rows):
            best = repeat_cold(safety, current, times=50)
    if best is None:
        raise AssertionError("The search has no start.")
    return best


def search_worst_qp(rng: np.random.Generator, tries: int, n: int = 8) -> tuple[int, int]:
    """Return the most iterations (and their rows) over random QPs and random changes of the worst ones."""
    best, at = (0, 0), None
    scale, u = np.eye(n), np.empty(n)
    for k in range(tries):
        if at is None or k % 3 == 0:
            m = int(rng.integers(2, 200))
            A, b, u_nom = rng.normal(size=(m, n)), rng.uniform(-1.0, 0.2, m), rng.uniform(-3.0, 3.0, n)
            A = A[:, :2] @ rng.normal(size=(2, n)) + 1e-3 * A if k % 4 == 0 else A
        else:
            A, b, u_nom = (x + 0.1 * rng.normal(size=x.shape) for x in at)
        result, iterations, _ = _kernel.solve_qp(scale, np.ascontiguousarray(A), b, -np.ones(n), np.ones(n), u_nom, u)
        if iterations >= best[0] or result == 2:
            best, at = (iterations, len(b)), (A, b, u_nom)
    return best


def load_panda() -> RobotModel:
    """Return the robot of the measurements."""
    return load_robot("panda")
