"""Forward invariance under an adversary: among static obstacles no h falls below zero, checked in float64 by numpy.

The adversary moves at full speed toward the nearest row (or bang-bang); the loop integrates ẏ = u exactly. Each
negative control changes one named parameter and must fail.
"""

import sys

import msgspec
import numpy as np
import pytest

from dualbrain.core.geometry.shapes import HalfSpace, Pose, Sphere
from dualbrain.safety.cbf.filter import Obstacle, SafetyFilter
from tests.safety import geometry_oracle, random_scenes
from tests.safety.conftest import panda, sparse_panda, state_at  # noqa: F401

MAX_RELAXED_SHARE, MAX_MEAN_RELAXED_SHARE = 0.03, 0.005
"""Largest shares of RELAXED steps of one run and of all runs; over 80 seeds 0.026 and 0.0028."""


def least_h(body, run, obstacles):
    """(h, step, which) of the worst case, in float64: obstacles and self-collision [m], joint limits [rad]."""
    parts = {
        "obstacle": geometry_oracle.h_obstacles(body, run.q, obstacles),
        "self": geometry_oracle.h_self(body, run.q),
        "joint": geometry_oracle.h_joints(body, run.q),
    }
    which = min(parts, key=lambda name: parts[name].min())
    return float(parts[which].min()), int(parts[which].argmin()), which


def loop(body, seed, steps, *, hold=None, obstacles=8, **changes):
    """The adversary keeps its direction for 0.15, 0.4 or 1 s, so that full speed is reached."""
    scene = random_scenes.random_scene(body, np.random.default_rng(seed), obstacles)
    safety = SafetyFilter(body, random_scenes.exact_config(**changes))
    safety.observe(scene, 0.0)
    hold = hold or (150, 400, 1000)[seed % 3]
    return random_scenes.closed_loop(safety, body.home, steps, seed, hold=hold, toward=0.9), scene


def holds(body, seed, steps):
    run, obstacles = loop(body, seed, steps)
    h, step, which = least_h(body, run, obstacles)
    assert h >= 0.0, f"seed {seed}: {which} h = {h * 1e3:.4f} mm at step {step}"
    assert run.tally["stopped"] == run.tally["fault"] == 0
    # curvature at full speed of all joints can outrun the acceleration limits
    assert run.tally["relaxed"] <= MAX_RELAXED_SHARE * steps
    change = np.abs(np.diff(run.u, axis=0, prepend=0.0)).max(axis=0)
    assert np.all(change <= np.array([j.acceleration.value for j in body.joints]) * body.period * (1 + 1e-5) + 1e-7)
    return run


@pytest.mark.parametrize("seed", range(6))
def test_no_h_below_zero(sparse_panda, seed):  # noqa: F811
    holds(sparse_panda, seed, 5000)


def test_rows_are_seldom_relaxed(sparse_panda):  # noqa: F811
    relaxed = sum(loop(sparse_panda, seed, 5000)[0].tally["relaxed"] for seed in range(12))
    assert relaxed <= MAX_MEAN_RELAXED_SHARE * 12 * 5000


def test_no_h_below_zero_with_every_sphere(panda):  # noqa: F811
    holds(panda, 50, 3000)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(1000, 1100))
def test_no_h_below_zero_in_a_million_steps(panda, seed):  # noqa: F811
    holds(panda, seed, 10_000)


# --- negative controls: one named parameter each ------------------------------------------------------------------


def report(control, h, step, which, seed):
    """The failing step and its depth, on the test's output (pytest -rP)."""
    sys.stdout.write(f"{control}: {which} h = {h * 1e3:.3f} mm at step {step} of seed {seed}\n")


def test_the_distance_of_a_stop_covers_a_gain_above_that_of_braking(sparse_panda):  # noqa: F811
    """α is 2.9 times the gain that the acceleration limits can follow."""
    run, obstacles = loop(sparse_panda, 6, 8000, hold=1000, obstacles=14, alpha=10.0)
    assert least_h(sparse_panda, run, obstacles)[0] >= 0.0


def test_control_with_an_overstated_acceleration_fails(sparse_panda):  # noqa: F811
    """The filter expects three times the acceleration of the plant."""
    for seed in (1, 3):
        assert run_with_stated_acceleration(sparse_panda, seed, 1.0)[0] >= 0.0
        h, step = run_with_stated_acceleration(sparse_panda, seed, 3.0)
        report("acceleration x 3", h, step, "obstacle", seed)
        assert h < -1e-2


def run_with_stated_acceleration(body, seed, share, steps=4000):
    """Worst (h, step) at obstacles; the robot model of the filter states `share` of the true accelerations."""
    rng = np.random.default_rng(seed)
    obstacles = random_scenes.random_scene(body, rng, 14)
    joints = tuple(
        msgspec.structs.replace(
            joint, acceleration=msgspec.structs.replace(joint.acceleration, value=share * joint.acceleration.value)
        )
        for joint in body.joints
    )
    safety = SafetyFilter(msgspec.structs.replace(body, joints=joints), random_scenes.exact_config())
    fastest = np.array([joint.velocity.value for joint in body.joints])
    change = np.array([joint.acceleration.value for joint in body.joints]) * body.period
    q, u, state, log = np.array(body.home), np.zeros(body.n), state_at.__wrapped__(), np.empty((steps, body.n))
    for k in range(steps):
        now = k * body.period
        if k % 400 == 0:
            nominal = rng.choice([-1.0, 1.0], body.n) * fastest
        safety.observe(obstacles, now)
        u = np.clip(safety.filter(state(q, u, t=now), nominal, now).u, u - change, u + change)
        q = q + body.period * u
        log[k] = q
    h = geometry_oracle.h_obstacles(body, log, obstacles, opening=0.04)
    return float(h.min()), int(h.argmin())


def test_control_without_margin_fails(sparse_panda):  # noqa: F811
    """Obstacles are observed 5 mm away from their true position; their margin is that bound, or zero."""
    for seed in range(3):
        assert run_with_position_error(sparse_panda, seed, 0.005)[0] >= 0.0
    worst = min((*run_with_position_error(sparse_panda, seed, 0.0), seed) for seed in range(3))
    report("margin 0", *worst)
    assert worst[0] < -1e-3


def run_with_position_error(body, seed, margin):
    rng = np.random.default_rng(seed)
    truth, seen = random_scenes.random_scene(body, rng, 14, gap=0.03), []
    for obstacle in truth:
        offset = rng.normal(size=3)
        place = np.array(obstacle.pose.position) + 0.005 * offset / np.linalg.norm(offset)
        pose = Pose(tuple(place), obstacle.pose.quaternion)
        seen.append(Obstacle(obstacle.name, obstacle.shape, pose, margin=margin))
    safety = SafetyFilter(body, random_scenes.exact_config())
    safety.observe(seen, 0.0)
    run = random_scenes.closed_loop(safety, body.home, 5000, seed, hold=1000, toward=0.9)
    return least_h(body, run, truth)


def test_control_without_the_obstacles_velocity_fails(sparse_panda):  # noqa: F811
    """A wall approaches at 6 cm/s while the arm pushes against it; the filter gets its velocity, or zero velocity."""
    assert push_against_moving_wall(sparse_panda, 1.0)[0] >= 0.0
    h, step = push_against_moving_wall(sparse_panda, 0.0)
    report("no n'v_o", h, step, "wall", "none")
    assert h < -1e-3


def push_against_moving_wall(body, reported, steps=2500):
    """Worst (h, step) in float64; the wall faces -x and starts at x = 0.65 m; `reported` scales its velocity."""
    safety, state = SafetyFilter(body, random_scenes.exact_config()), state_at.__wrapped__()
    q, log = np.array(body.home), np.empty((steps, body.n))
    turn = (0.5**0.5, 0.0, -(0.5**0.5), 0.0)
    for k in range(steps):
        now, x = k * 1e-3, 0.65 - 0.06 * k * 1e-3
        wall = Obstacle(
            "wall", HalfSpace(), Pose((x, 0.0, 0.0), turn), velocity=(-0.06 * reported, 0.0, 0.0), static=False
        )
        safety.observe([wall], now)
        push = np.linalg.pinv(safety.tool(q).jacobian) @ np.array([0.3, 0.0, 0.0, 0.0, 0.0, 0.0])
        q = q + 1e-3 * safety.filter(state(q, t=now), push, now).u
        log[k] = q
    start = Obstacle("wall", HalfSpace(), Pose((0.65, 0.0, 0.0), turn))
    shifts = np.zeros((steps, 1, 3))
    shifts[:, 0, 0] = -0.06e-3 * np.arange(1, steps + 1)
    h = geometry_oracle.h_obstacles(body, log, [start], opening=0.04, shifts=shifts)
    return float(h.min()), int(h.argmin())


def test_a_start_inside_a_sphere_is_left_monotonically(sparse_panda):  # noqa: F811
    obstacles = [Obstacle("ball", Sphere(0.06), Pose((0.5, 0.12, 0.45)))]
    safety = SafetyFilter(sparse_panda, random_scenes.exact_config())
    safety.observe(obstacles, 0.0)
    q, h = np.array(sparse_panda.home), []
    state = state_at.__wrapped__()
    for _ in range(2500):
        answer = safety.filter(state(q), np.zeros(7), 0.0)
        h.append(answer.h_min)
        q = q + 1e-3 * answer.u
    assert np.all(np.diff(h) > -1e-6)
    assert h[-1] > -1e-3
