"""Trust region: rows are left out where no result is expected, but the result is always that of all rows.

The nominal control jumps every few steps, so that results are in the old trust region, in the new one, or only in the
whole box. The box is wide, as without acceleration limits or with long control periods. An independent solver (DAQP)
gets every row that the filter can pose.
"""

from ctypes import c_int

import daqp
import msgspec
import numpy as np
import pytest

from dualbrain.core.geometry.shapes import Pose, Sphere
from dualbrain.errors import ConfigurationError
from dualbrain.safety.cbf.filter import FilterStatus, Obstacle, SafetyFilter
from tests.safety import random_scenes


def optimum(A, b, lower, upper, u_nom, v_max):
    """min Σ ((u − u_nom)/v_max)² s.t. A u ≥ b within the box, or None if infeasible."""
    n = len(u_nom)
    H = np.diag(v_max**-2.0)
    top, bottom = np.concatenate([upper, np.full(len(b), 1e30)]), np.concatenate([lower, b])
    u, _, flag, _ = daqp.solve(H, -H @ u_nom, np.ascontiguousarray(A), top, bottom, np.zeros(n + len(b), c_int))
    return np.array(u) if flag == 1 else None


def crowd(body, rng, count):
    """Spheres around the arm at home, at least 4 cm away."""
    centres, radii, _ = SafetyFilter(body).spheres(np.array(body.home), 0.0)
    obstacles = []
    while len(obstacles) < count:
        at = rng.uniform([0.1, -0.6, 0.0], [0.9, 0.6, 1.0])
        if 0.04 < np.min(np.linalg.norm(centres - at, axis=1) - radii) - 0.04 < 0.3:
            obstacles.append(Obstacle(f"o{len(obstacles)}", Sphere(0.04), Pose(tuple(at.tolist()))))
    return obstacles


def loop(safety, rng, steps, hold):
    """(result, u_nom, v_max) along a bang-bang closed loop."""
    body = safety.robot_model
    v_max = np.array([joint.velocity.value for joint in body.joints])
    q, desired, rest = np.array(body.home), np.zeros(body.n), np.zeros(body.n)
    for step in range(steps):
        if step % hold == 0:
            desired = v_max * rng.choice([-1.0, 1.0, 0.3], body.n)
        answer = safety(q, rest, desired)
        yield answer, desired, v_max
        q = q + body.period * answer.u


@pytest.mark.parametrize("period", [1e-3, 2e-2], ids=["no acceleration limits", "long periods"])
def test_the_result_is_that_of_all_rows(sparse_panda, period):
    rng, body = np.random.default_rng(3), msgspec.structs.replace(sparse_panda, period=period)
    config = random_scenes.exact_config(
        precision="float64", acceleration_limits=period > 1e-3, alpha=sparse_panda.alpha
    )
    safety = SafetyFilter(body, config)
    safety.observe(crowd(body, rng, 12))
    modified = left_out = 0
    for answer, u_nom, v_max in loop(safety, rng, 300, 9):
        rows, (low, high) = safety.rows(), safety._kernel.box()
        if answer.status not in (FilterStatus.SAFE, FilterStatus.MODIFIED):
            continue
        A, b = np.array([row.a for row in rows]).reshape(-1, body.n), np.array([row.b for row in rows])
        best = optimum(A, b, np.array(low), np.array(high), u_nom, v_max)
        assert len(rows) < 512, "the readout must be complete"
        assert best is not None
        np.testing.assert_allclose(answer.u, best, atol=3e-5)
        modified += bool(np.max(np.abs(answer.u - u_nom)) > 1e-3)
        left_out += answer.n_rows < len(rows) / 2
    assert modified > 100
    assert left_out > 100


def test_a_safe_nominal_passes_bit_for_bit_for_any_last_control(sparse_panda):
    """A nominal control that satisfies all rows is returned unchanged, also after a distant last control."""
    rng = np.random.default_rng(5)
    safety = SafetyFilter(sparse_panda, random_scenes.exact_config(acceleration_limits=False, alpha=sparse_panda.alpha))
    safety.observe(crowd(sparse_panda, rng, 25))
    q, rest, passed = np.array(sparse_panda.home), np.zeros(sparse_panda.n), 0
    v_max = np.array([joint.velocity.value for joint in sparse_panda.joints])
    for _ in range(60):
        safety(q, rest, v_max * rng.choice([-1.0, 1.0], sparse_panda.n))
        gentle = np.float32(rng.uniform(-0.05, 0.05, sparse_panda.n)).astype(float)
        answer = safety(q, rest, gentle)
        if answer.status is FilterStatus.SAFE:
            passed += 1
            assert answer.delta == 0.0
            assert np.array_equal(answer.u, gentle)
    assert passed > 30


def test_hundreds_of_obstacles(panda):
    """400 spheres against every sphere of the robot, with a certificate."""
    safety = SafetyFilter(panda)
    safety.observe(crowd(panda, np.random.default_rng(7), 400))
    answers = [answer for answer, _, _ in loop(safety, np.random.default_rng(8), 60, 20)]
    assert all(answer.certified for answer in answers)
    assert min(answer.h_min for answer in answers) >= 0.0


@pytest.mark.parametrize(("which", "value"), [(0, np.zeros(6)), (1, np.zeros((7, 1))), (2, np.zeros(8)), (2, "fast")])
def test_arrays_of_another_shape_are_named(panda, which, value):
    given = [np.array(panda.home), np.zeros(7), np.zeros(7)]
    given[which] = value
    with pytest.raises(ConfigurationError, match=("q", "v", "u_nom")[which]) as caught:
        SafetyFilter(panda)(*given)
    assert "(7,)" in caught.value.allowed
    assert caught.value.got == (value if isinstance(value, str) else value.shape)


def test_lists_and_other_number_types_are_accepted(panda):
    safety = SafetyFilter(panda)
    answer = safety(list(panda.home), [0] * 7, np.zeros(7, np.float32))
    assert answer.status is FilterStatus.SAFE
    assert answer.u_nom.dtype == np.float64


def test_a_rejected_input_has_no_distances(panda):
    safety = SafetyFilter(panda)
    safety.observe([Obstacle("ball", Sphere(0.05), Pose((0.5, 0.0, 0.5)))])
    fine = safety(np.array(panda.home), np.zeros(7), np.zeros(7))
    rejected = safety(np.array(panda.home), np.zeros(7), np.full(7, np.nan))
    assert np.isfinite(fine.h_min)
    assert rejected.status is FilterStatus.STOPPED
    assert np.isnan(rejected.h_min)
    assert safety.rows() == ()


def test_rows_have_names(panda):
    safety = SafetyFilter(panda)
    safety.observe([Obstacle("ball", Sphere(0.05), Pose((0.4, 0.0, 0.75)))])
    answer = safety(np.array(panda.home), np.zeros(7), np.zeros(7))
    rows = safety.rows()
    assert rows
    nearest = min(rows, key=lambda row: row.h)
    assert nearest.h == answer.h_min
    assert nearest.name.endswith("vs 'ball'")
    assert nearest.barrier == "obstacle"
    assert np.linalg.norm(nearest.a) == pytest.approx(1.0, abs=1e-6)
