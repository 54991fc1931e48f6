"""Barrier rows against finite differences of independently computed distances."""

import numpy as np
import pytest

from dualbrain.core.geometry.shapes import Box, Capsule, HalfSpace, Pose, Sphere
from dualbrain.safety.cbf.filter import Obstacle, SafetyFilter
from tests.safety import geometry_oracle, random_scenes

STEP = 1e-6


def random_obstacles(rng, velocity=(0.0, 0.0, 0.0)):
    shapes = [Sphere(0.05), Capsule(0.03, 0.1), Box((0.05, 0.08, 0.1)), HalfSpace()]
    poses = [
        Pose(tuple(rng.uniform([0.2, -0.4, 0.1], [0.7, 0.4, 0.7])), random_scenes.random_quaternion(rng))
        for _ in range(3)
    ]
    return [
        Obstacle(f"o{i}", shape, pose, velocity=velocity, static=velocity == (0.0, 0.0, 0.0))
        for i, (shape, pose) in enumerate(zip(shapes, [*poses, Pose((0, 0, 0))], strict=True))
    ]


def gap(body, names, q, kind, i, j, obstacles):
    centres, radii, _ = geometry_oracle.sphere_centres(body, q[None])
    if kind == 0:
        return geometry_oracle.surface_distance(obstacles[j].shape, obstacles[j].pose, centres[0, i]) - radii[i]
    return np.linalg.norm(centres[0, i] - centres[0, j]) - radii[i] - radii[j]


def every_row(body, q, obstacles, **changes):
    """A filter without acceleration limits, which has every row that the velocity limits can reach."""
    safety = SafetyFilter(body, random_scenes.exact_config(precision="float64", acceleration_limits=False, **changes))
    safety.observe(obstacles, 0.0)
    return safety


def test_rows_are_gradients_of_h(sparse_panda, rng, random_posture, state_at):
    checked = np.zeros(2, int)
    for _ in range(6):
        q, obstacles = random_posture(rng), random_obstacles(rng)
        safety = every_row(sparse_panda, q, obstacles)
        safety.filter(state_at(q, opening=0.0), np.zeros(7), 0.0)
        rows = safety._kernel.rows()
        for kind, i, j, h, norm, _, a in (rows[r] for r in rng.choice(len(rows), min(25, len(rows)), replace=False)):
            here = gap(sparse_panda, None, q, kind, i, j, obstacles)
            assert h == pytest.approx(here - safety.config.rounding_margin, abs=1e-6)
            if h < 0.0:
                continue  # inside a box the normal changes from face to face
            slope = np.empty(7)
            for k in range(7):
                e = np.zeros(7)
                e[k] = STEP
                ahead = gap(sparse_panda, None, q + e, kind, i, j, obstacles)
                slope[k] = (ahead - gap(sparse_panda, None, q - e, kind, i, j, obstacles)) / (2 * STEP)
            np.testing.assert_allclose(np.array(a) * norm, slope, atol=1e-6)
            checked[kind] += 1
    assert np.all(checked > 10)


def test_right_sides_are_alpha_h_plus_motion_of_the_obstacle(sparse_panda, rng, random_posture, state_at):
    velocity = (0.1, -0.2, 0.15)
    q, obstacles = random_posture(rng), random_obstacles(rng, velocity)
    safety = every_row(sparse_panda, q, obstacles)
    safety.filter(state_at(q, opening=0.0), np.zeros(7), 0.0)
    seen = 0
    for kind, i, j, h, norm, b, _ in safety._kernel.rows():
        if kind == 1 or h < 1e-3:
            continue
        pose = obstacles[j].pose
        ahead = Pose(tuple(np.array(pose.position) + STEP * np.array(velocity)), pose.quaternion)
        moved = Obstacle("m", obstacles[j].shape, ahead)
        approach = (
            gap(sparse_panda, None, q, kind, i, 0, [moved]) - gap(sparse_panda, None, q, kind, i, j, obstacles)
        ) / STEP
        expected = -sparse_panda.alpha * (h - safety.config.sampling_margin) - approach
        assert expected - 2e-6 <= b * norm <= expected + 2e-3  # the sampling term only increases the bound
        seen += 1
        if seen == 60:
            break
    assert seen > 20


def test_the_box_has_velocity_acceleration_and_braking_limits(sparse_panda, state_at):
    safety = SafetyFilter(sparse_panda, random_scenes.exact_config(precision="float64"))
    q = np.array(sparse_panda.home)
    q[0] = sparse_panda.joints[0].upper.value - 0.01
    q[1] = sparse_panda.joints[1].lower.value - 0.01  # outside
    u_prev = np.array([0.03, 0.0, 1.0, 2.17, 0.0, 0.0, 0.0])
    safety.reset(u_prev)
    safety.filter(state_at(q), np.zeros(7), 0.0)
    low, high = (np.array(side) for side in safety._kernel.box())
    step = np.array([j.acceleration.value for j in sparse_panda.joints]) * sparse_panda.period
    assert high[0] == pytest.approx(min(sparse_panda.alpha * (0.01 - 1e-5), u_prev[0] + step[0]))
    assert low[1] == high[1] == pytest.approx(step[1])  # returns as fast as the acceleration allows
    assert (low[2], high[2]) == pytest.approx((1.0 - step[2], 1.0 + step[2]))
    assert high[3] == pytest.approx(2.175)


def test_a_row_is_left_out_only_when_it_cannot_bind(sparse_panda, rng, random_posture, state_at):
    """Every pair without a row is satisfied at every corner of the box."""
    for _ in range(5):
        q, obstacles = random_posture(rng), random_obstacles(rng)
        u_prev = rng.uniform(-1.0, 1.0, 7)
        full = every_row(sparse_panda, q, obstacles)
        full.filter(state_at(q, opening=0.0), np.zeros(7), 0.0)
        culled = SafetyFilter(sparse_panda, random_scenes.exact_config(precision="float64"))
        culled.observe(obstacles, 0.0)
        culled.reset(u_prev)
        culled.filter(state_at(q, opening=0.0), u_prev, 0.0)
        low, high = (np.array(side) for side in culled._kernel.box())
        kept = {row[:3] for row in culled._kernel.rows()}
        for kind, i, j, h, norm, _, row in full._kernel.rows():
            if (kind, i, j) not in kept:
                a = np.array(row)
                worst = np.sum(np.where(a > 0, a * low, a * high))
                assert worst * norm >= -sparse_panda.alpha * (h - 2e-4) - 1e-9
                assert h > 1e-3


def test_h_min_is_the_smallest_h_of_all(sparse_panda, rng, random_posture, state_at):
    for _ in range(10):
        q, obstacles = random_posture(rng), random_obstacles(rng)
        safety = SafetyFilter(sparse_panda, random_scenes.exact_config(precision="float64"))
        safety.observe(obstacles, 0.0)
        got = safety.filter(state_at(q, opening=0.0), np.zeros(7), 0.0).h_min
        least = min(
            geometry_oracle.h_obstacles(sparse_panda, q[None], obstacles)[0],
            geometry_oracle.h_self(sparse_panda, q[None])[0],
        )
        assert got == pytest.approx(least - safety.config.rounding_margin, abs=2e-6)
