"""Relaxation: rank by rank the least violation, compared with linear programs, with braking as the reference."""

import numpy as np
import pytest
from scipy.optimize import linprog

from dualbrain.core.geometry.shapes import Capsule, HalfSpace, Pose, Sphere
from dualbrain.safety.barriers.scenarios import moving_spheres
from dualbrain.safety.cbf.filter import ConstraintRow, FilterStatus, Obstacle, Rank, SafetyFilter
from tests.safety import geometry_oracle, random_scenes


def lexicographic(rows, low, high):
    """The least largest violation of each rank, given those of higher ranks; no pair is violated more than at rest."""
    A, b = [np.array(row.a) for row in rows], [row.b for row in rows]
    n, granted, least = len(low), {}, {}
    for rank in Rank:
        upper, right = [], []
        for row, a, value in zip(rows, A, b, strict=True):
            pair = row.rank <= Rank.OBSTACLE
            if pair:
                upper.append([*(-a), 0.0])
                right.append(-min(value, 0.0))
            if row.rank <= rank and not (pair and value <= 0.0):
                upper.append([*(-a), -1.0 if row.rank == rank else 0.0])
                right.append(-value + granted.get(row.rank, 0.0))
        answer = linprog([0.0] * n + [1.0], upper, right, bounds=[*zip(low, high, strict=True), (0.0, None)])
        assert answer.success
        granted[rank] = answer.x[-1] + 1e-9
        least[rank] = answer.x[-1]
    return least


def contradicting(rng, n):
    """Rows of all ranks around two opposite directions, which no control satisfies together."""
    ahead = rng.normal(size=n)
    rows = []
    for index in range(8):
        side = 1.0 if index % 2 else -1.0
        a = side * ahead + 0.4 * rng.normal(size=n)
        b = rng.uniform(-0.02, 0.03)
        rows.append(ConstraintRow(name=f"user_rows: {index}", a=tuple(a), b=b, rank=Rank(int(rng.integers(1, 5)))))
    return rows


@pytest.mark.parametrize("seed", range(40))
def test_violations_are_the_least_rank_by_rank(sparse_panda, state_at, seed):
    rng = np.random.default_rng(seed)
    rows = contradicting(rng, 7)
    safety = SafetyFilter(sparse_panda, random_scenes.exact_config(precision="float64"))
    safety.constrain(rows)
    answer = safety.filter(state_at(sparse_panda.home), np.zeros(7), 0.0)
    low, high = (np.array(side) for side in safety._kernel.box())
    best = [float(np.maximum(np.array(r.a) * low, np.array(r.a) * high).sum()) for r in rows]
    capped = [
        ConstraintRow(name=r.name, a=r.a, b=min(r.b, reach), rank=r.rank) for r, reach in zip(rows, best, strict=True)
    ]
    expected = lexicographic(capped, low, high)
    got = {rank: max([0.0, *(r.b - np.array(r.a) @ answer.u for r in capped if r.rank == rank)]) for rank in Rank}
    if max(expected.values()) < 1e-6 and answer.status is not FilterStatus.RELAXED:
        return
    for rank in Rank:
        assert got[rank] == pytest.approx(expected[rank], abs=2e-5), (rank, got, expected)


def test_the_seeds_above_do_relax(sparse_panda, state_at):
    statuses = []
    for seed in range(40):
        safety = SafetyFilter(sparse_panda, random_scenes.exact_config(precision="float64"))
        safety.constrain(contradicting(np.random.default_rng(seed), 7))
        statuses.append(safety.filter(state_at(sparse_panda.home), np.zeros(7), 0.0).status)
    assert statuses.count(FilterStatus.RELAXED) > 10


@pytest.mark.parametrize("seed", range(5))
def test_a_relaxed_result_depends_on_the_state_alone_and_passes_unchanged(sparse_panda, state_at, seed):
    rng = np.random.default_rng(100 + seed)
    rows, answers = contradicting(rng, 7), []
    nominal = np.zeros(7)
    for _ in range(3):
        safety = SafetyFilter(sparse_panda, random_scenes.exact_config())
        safety.constrain(rows)
        answers.append(safety.filter(state_at(sparse_panda.home), nominal, 0.0))
        nominal = answers[-1].u
    if answers[0].status is FilterStatus.RELAXED:
        np.testing.assert_array_equal(answers[1].u, answers[0].u)
        assert answers[1].delta == 0.0


@pytest.mark.parametrize("seed", range(30))
def test_no_pair_is_violated_more_than_by_braking(sparse_panda, state_at, seed):
    """Passive safety: from any motion, no pair is approached faster than by a braking robot."""
    rng = np.random.default_rng(200 + seed)
    rows, safety = contradicting(rng, 7), SafetyFilter(sparse_panda, random_scenes.exact_config(precision="float64"))
    step = np.array([joint.acceleration.value for joint in sparse_panda.joints]) * sparse_panda.period
    u_prev = rng.uniform(-0.3, 0.3, 7)
    keep = max(0.0, float(np.max(1.0 - step / np.abs(u_prev))))
    brake = np.clip(keep * u_prev, u_prev - step, u_prev + step)
    safety.constrain(rows)
    safety.reset(u_prev)
    answer = safety.filter(state_at(sparse_panda.home), rng.uniform(-1, 1, 7), 0.0)
    assert answer.status in (FilterStatus.RELAXED, FilterStatus.MODIFIED)
    for row in (row for row in rows if row.rank <= Rank.OBSTACLE):
        assert np.dot(row.a, answer.u) >= min(row.b, np.dot(row.a, brake)) - 1e-7


def test_relaxed_ranks_are_reported(sparse_panda, state_at):
    a = np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    safety = SafetyFilter(sparse_panda, random_scenes.exact_config())
    safety.constrain(
        [
            ConstraintRow(name="user_rows: left", a=tuple(a), b=0.01, rank=Rank.BODY),
            ConstraintRow(name="user_rows: right", a=tuple(-a), b=0.01, rank=Rank.TASK),
        ]
    )
    answer = safety.filter(state_at(sparse_panda.home), np.zeros(7), 0.0)
    assert (answer.status, answer.relaxed_ranks) == (FilterStatus.RELAXED, (Rank.TASK,))
    assert answer.u[0] == pytest.approx(0.01, abs=1e-4)
    assert "user_rows" in answer.barriers


def test_no_static_obstacle_that_braking_spares_is_violated_for_a_person(sparse_panda):
    """With a wall behind the arm and a person who approaches faster than it can evade, the wall is never entered."""
    safety = SafetyFilter(sparse_panda, random_scenes.exact_config())
    q = np.array(sparse_panda.home)
    centres, radii = moving_spheres(safety, q)
    back = float(np.min(centres[:, 0] - radii)) - 0.01
    wall = Obstacle("wall", HalfSpace(), Pose((back, 0.0, 0.0), (0.5**0.5, 0.0, 0.5**0.5, 0.0)))
    least, relaxed = np.inf, 0
    for tick in range(900):
        now = 1e-3 * tick
        person = Obstacle(
            "person",
            Capsule(0.1, 0.4),
            Pose((1.0 - 0.8 * now, 0.0, 0.5)),
            velocity=(-0.8, 0.0, 0.0),
            static=False,
            rank=Rank.BODY,
        )
        safety.observe([wall, person], now)
        answer = safety(q, np.zeros(7), np.zeros(7), now)
        relaxed += answer.status is FilterStatus.RELAXED
        q = q + 1e-3 * answer.u
        least = min(least, geometry_oracle.h_obstacles(sparse_panda, q[None], [wall])[0])
    assert relaxed > 0
    assert least >= 0.0


# --- recovery from violated barriers -------------------------------------------------------------------------------

INSIDE = {
    "ball": Obstacle("obstacle", Sphere(0.06), Pose((0.5, 0.12, 0.45))),
    "capsule": Obstacle("obstacle", Capsule(0.05, 0.1), Pose((0.5, 0.1, 0.45))),
    "wall": Obstacle("obstacle", HalfSpace(), Pose((0.48, 0.0, 0.0), (0.5**0.5, 0.0, -(0.5**0.5), 0.0))),
}


def drift(safety, q, nominal, ticks=2500):
    """h_min along a closed loop, and the last q."""
    values = []
    for _ in range(ticks):
        answer = safety(q, np.zeros(7), nominal(q))
        values.append(answer.h_min)
        q = q + 1e-3 * answer.u
    return np.array(values), q


@pytest.mark.parametrize("name", INSIDE)
def test_a_start_inside_an_obstacle_is_left_monotonically(sparse_panda, name):
    safety = SafetyFilter(sparse_panda, random_scenes.exact_config())
    safety.observe([INSIDE[name]])
    h, _ = drift(safety, np.array(sparse_panda.home), lambda q: np.zeros(7), 4000)
    assert h[0] < -0.005
    assert np.all(np.diff(h) > -1e-6)
    assert h[-1] > -1.5e-3


def test_a_start_outside_a_joint_limit_is_left_monotonically(sparse_panda):
    safety = SafetyFilter(sparse_panda, random_scenes.exact_config())
    q = np.array(sparse_panda.home)
    upper = sparse_panda.joints[0].upper.value
    q[0] = upper + 0.1
    outside = []
    for _ in range(2000):
        q = q + 1e-3 * safety(q, np.zeros(7), np.array([1.0, 0, 0, 0, 0, 0, 0])).u
        outside.append(q[0] - upper)
    assert np.all(np.diff(outside) <= 1e-9)
    assert outside[-1] < 2e-3


def test_a_start_in_self_collision_is_left_monotonically(sparse_panda):
    safety = SafetyFilter(sparse_panda, random_scenes.exact_config())
    folded = np.array([-0.64, 1.66, -0.08, -2.74, 0.5, 1.17, 0.84])
    h, _ = drift(safety, folded, lambda q: np.zeros(7), 4000)
    assert h[0] < -0.01
    assert np.all(np.diff(h) > -1e-6)
    assert h[-1] > -1.5e-3


def test_moving_away_is_never_slowed_down(sparse_panda):
    """From inside, a nominal control that leaves faster than the recovery speed passes unchanged."""
    safety = SafetyFilter(sparse_panda, random_scenes.exact_config(recovery_speed=0.02))
    safety.observe([INSIDE["wall"]])
    q, u = np.array(sparse_panda.home), np.zeros(7)
    for tick in range(300):
        J = safety.tool(q).jacobian
        desired = J.T @ np.linalg.solve(J @ J.T + 1e-4 * np.eye(6), np.array([-min(0.1, tick * 4e-4), 0, 0, 0, 0, 0]))
        answer = safety(q, np.zeros(7), desired)
        if tick > 250:
            assert answer.status is FilterStatus.SAFE
            assert np.allclose(answer.u, desired, atol=1e-6)
        u = answer.u
        q = q + 1e-3 * u
