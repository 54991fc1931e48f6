"""Adversarial closed loops and a search for the worst moment: QP iterations, rows, and processor time of one step."""

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
"""Things around the arm; the table is one more."""


@dataclass(slots=True)
class StepCase:
    """What one step started from, and what it needed."""

    scene: int
    q: Array
    u_prev: Array
    u_nom: Array
    iterations: int
    rows: int
    seconds: float


def random_obstacles(rng: np.random.Generator, count: int, *, moving: bool) -> list[Obstacle]:
    """A table and `count` spheres, capsules and boxes where the arm works; they may touch it."""
    things = [Obstacle("table", HalfSpace(), Pose((0.0, 0.0, 0.0)), known=True)]
    for k in range(count):
        turn, reach = rng.uniform(-np.pi, np.pi), rng.uniform(0.3, 0.85)
        quaternion = rng.normal(size=4)
        pose = Pose(
            (float(reach * np.cos(turn)), float(reach * np.sin(turn)), float(rng.uniform(0.05, 0.9))),
            tuple((quaternion / np.linalg.norm(quaternion)).tolist()),
        )
        size = rng.uniform(0.02, 0.08, 3).tolist()
        shape = (Sphere(size[0]), Capsule(size[0], size[1]), Box(tuple(size)))[int(rng.integers(3))]
        velocity = tuple(rng.uniform(-0.2, 0.2, 3).tolist()) if moving else (0.0, 0.0, 0.0)
        things.append(Obstacle(f"o{k}", shape, pose, velocity, static=not moving))
    return things


def make_filter(robot_model: RobotModel, seed: int) -> SafetyFilter:
    """The filter of scene `seed`: as shipped, states at rest."""
    rng = np.random.default_rng(seed)
    count, moving = OBSTACLE_COUNTS[seed % len(OBSTACLE_COUNTS)], seed % 2 == 1
    safety = SafetyFilter(robot_model, FilterConfig())
    safety.observe(random_obstacles(rng, count, moving=moving), 0.0)
    return safety


def adversarial_loop(robot_model: RobotModel, seed: int, steps: int) -> Iterator[StepCase]:
    """Bang-bang, or straight at the row with the smallest h; a twin filter is timed in C on the same inputs.

    The scene stands still for the loop (velocities enter the rows), so that both see the same at every step.
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
        answer = safety(q, rest, u_nom)
        seconds = twin._kernel.time_steps(q[None], u_nom[None], False)
        yield StepCase(seed, q.copy(), u_prev.copy(), u_nom.copy(), answer.iterations, answer.n_rows, seconds)
        u_prev = answer.u
        q = q + robot_model.period * answer.u


def repeat_cold(safety: SafetyFilter, m: StepCase, *, times: int = 1) -> StepCase:
    """The same step without a warm start; the least of `times` times, so that a busy machine does not count."""
    rest, least = np.zeros(len(m.q)), np.inf
    safety.reset(m.u_prev)
    answer = safety(m.q, rest, m.u_nom)
    for _ in range(times):
        safety.reset(m.u_prev)
        least = min(least, safety._kernel.time_steps(m.q[None], m.u_nom[None], True))
    return StepCase(m.scene, m.q, m.u_prev, m.u_nom, answer.iterations, answer.n_rows, least)


def search_worst_step(robot_model: RobotModel, start: list[StepCase], rng: np.random.Generator, tries: int) -> StepCase:
    """Random changes of posture, last control and wish that need more iterations (then more rows) are kept."""
    v_max = np.array([joint.velocity.value for joint in robot_model.joints])
    best: StepCase | None = None
    for first in start:
        safety = make_filter(robot_model, first.scene)
        here = repeat_cold(safety, first)
        for k in range(tries):
            size = (0.3, 0.1, 0.02)[k % 3]
            there = repeat_cold(
                safety,
                StepCase(
                    first.scene,
                    here.q + size * rng.normal(size=robot_model.n),
                    np.clip(here.u_prev + size * v_max * rng.normal(size=robot_model.n), -v_max, v_max),
                    np.clip(here.u_nom + size * v_max * rng.normal(size=robot_model.n), -v_max, v_max),
                    0,
                    0,
                    0.0,
                ),
            )
            if (there.iterations, there.rows) >= (here.iterations, here.rows):
                here = there
        if best is None or (here.iterations, here.rows) > (best.iterations, best.rows):
            best = repeat_cold(safety, here, times=50)
    if best is None:
        raise AssertionError("a search starts somewhere")
    return best


def search_worst_qp(rng: np.random.Generator, tries: int, n: int = 8) -> tuple[int, int]:
    """Most iterations (and their rows) over random QPs, the worst of which are changed at random and tried again."""
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
    """The body that the figures are for."""
    return load_robot("panda")
