"""Acceleration filter: geometry against MuJoCo and differences, margin, box, closed loops and negative controls."""

import msgspec
import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dualbrain.core.geometry.shapes import Box, Capsule, HalfSpace, Pose, Sphere
from dualbrain.errors import ConfigurationError, GeometryError, UnknownNameError
from dualbrain.robots.loader import load_robot
from dualbrain.safety.cbf.obstacles import Obstacle, SpeedAndSeparation
from dualbrain.safety.cbf.result import FilterStatus, Reason
from dualbrain.safety.higher_order import AccelerationConfig, AccelerationFilter
from dualbrain.safety.higher_order.acceleration_box import acceleration_box, joint_limits
from dualbrain.safety.higher_order.distances import Solids
from dualbrain.safety.higher_order.sphere_kinematics import SphereKinematics
from tests.safety import geometry_oracle, mujoco_oracle, random_scenes

PANDA = load_robot("panda")
SMALL = msgspec.structs.replace(PANDA, spheres=PANDA.spheres[::4])
"""The Panda with every fourth sphere: the same kinematics at a quarter of the cost."""
LIMITS = joint_limits(PANDA)
TABLE = Obstacle(name="table", shape=HalfSpace(), pose=Pose((0.0, 0.0, 0.0)))


def random_motion(rng, robot_model=PANDA, share=0.5):
    """A posture inside the limits and velocities up to `share` of the velocity limits."""
    limits = joint_limits(robot_model)
    q = rng.uniform(limits.lower + 0.2, limits.upper - 0.2)
    return q, share * rng.uniform(-limits.velocity, limits.velocity)


def one_of_each_solid(rng):
    """One obstacle of each kind of solid, one of them moving."""
    return [
        TABLE,
        Obstacle(
            name="ball",
            shape=Sphere(0.1),
            pose=Pose((0.5, 0.3, 0.5)),
            velocity=(0.3, -0.2, 0.1),
            velocity_error=0.05,
            static=False,
        ),
        Obstacle(
            name="post",
            shape=Capsule(0.05, 0.3),
            pose=Pose((0.4, -0.4, 0.3), random_scenes.random_quaternion(rng)),
            margin=0.01,
        ),
        Obstacle(
            name="crate", shape=Box((0.1, 0.2, 0.15)), pose=Pose((-0.4, 0.3, 0.3), random_scenes.random_quaternion(rng))
        ),
    ]


# --- geometry -----------------------------------------------------------------------------------------------------


def test_motion_of_the_spheres_agrees_with_mujoco(rng):
    model = mujoco.MjModel.from_xml_string(mujoco_oracle.build_mjcf(PANDA))
    data = mujoco.MjData(model)
    spheres, geoms = SphereKinematics(PANDA), [model.geom(name).id for name in mujoco_oracle.sphere_names(PANDA)]

    def jacobians(q):
        data.qpos[:] = q
        mujoco.mj_forward(model, data)
        out = np.empty((len(geoms), 3, 7))
        for k, geom in enumerate(geoms):
            mujoco.mj_jacGeom(model, data, out[k], None, geom)
        return out

    for _ in range(5):
        q, v = random_motion(rng, share=1.0)
        motion, J = spheres.motion(q, v, 0.0), jacobians(q)
        np.testing.assert_allclose(motion.centres, data.geom_xpos[geoms], atol=1e-9)
        np.testing.assert_allclose(motion.jacobian.transpose(0, 2, 1), J, atol=1e-9)
        np.testing.assert_allclose(motion.velocities, J @ v, atol=1e-9)
        eps = 1e-5
        np.testing.assert_allclose(
            motion.bias, (jacobians(q + eps * v) - jacobians(q - eps * v)) @ v / (2 * eps), atol=1e-6
        )


def test_no_lever_is_longer_than_its_upper_bound(rng):
    spheres = SphereKinematics(PANDA)
    for _ in range(200):
        q = rng.uniform(LIMITS.lower, LIMITS.upper)
        assert np.all(spheres.motion(q, np.zeros(7), 0.04).lever_lengths <= spheres.max_levers + 1e-12)


@pytest.mark.parametrize("shape", [Sphere(0.2), Capsule(0.1, 0.3), Box((0.1, 0.2, 0.3)), HalfSpace()])
def test_the_curvature_of_distances_agrees_with_differences(shape, rng):
    obstacle = Obstacle(name="it", shape=shape, pose=Pose((0.0, 0.0, 0.0), random_scenes.random_quaternion(rng)))
    solids, eps, curved = Solids([obstacle]), 1e-4, 0
    for _ in range(200):
        point, w = rng.uniform(-0.6, 0.6, 3), rng.uniform(-1.0, 1.0, 3)
        here, after, before = (
            geometry_oracle.surface_distance(shape, obstacle.pose, p) for p in (point, point + eps * w, point - eps * w)
        )
        gaps = solids.measure(point[None, None], w[None, None], np.full((1, 1), eps * 2.0))
        assert gaps.d[0, 0] - gaps.core_radius[0] == pytest.approx(here, abs=1e-12)
        if here < 0.02 or not gaps.feature_stable[0, 0]:
            continue
        assert gaps.n[0, 0] @ w == pytest.approx((after - before) / (2 * eps), abs=1e-4)
        assert gaps.kappa[0, 0] == pytest.approx((after - 2 * here + before) / eps**2, abs=2e-3)
        curved += gaps.kappa[0, 0] > 1e-3
    assert (curved > 30) != isinstance(shape, HalfSpace)


def test_a_point_inside_a_box_or_on_an_axis_has_a_unit_normal():
    obstacles = [
        Obstacle(name="box", shape=Box((0.1, 0.2, 0.3)), pose=Pose((0.0, 0.0, 0.0))),
        Obstacle(name="ball", shape=Sphere(0.1), pose=Pose((0, 0, 0))),
    ]
    gaps = Solids(obstacles).measure(np.zeros((2, 1, 3)), np.zeros((2, 1, 3)), np.zeros((2, 1)))
    for i, obstacle in enumerate(obstacles[::-1]):  # spheres come first
        assert np.linalg.norm(gaps.n[i, 0]) == pytest.approx(1.0)
        assert gaps.d[i, 0] - gaps.core_radius[i] == pytest.approx(-0.1, abs=1e-8), obstacle.name


def with_prismatic_joint(body):
    """The robot model with a prismatic fourth joint."""
    joints = [msgspec.structs.replace(j, kind="prismatic") if k == 3 else j for k, j in enumerate(body.joints)]
    return msgspec.structs.replace(body, joints=tuple(joints), spheres=body.spheres[::3])


def all_rows(safety, q, v, age=0.0, wide=1e6):
    """All pairs with their rows, without culling."""
    box = np.full(len(q), wide)
    pairs = safety._pairs(q, v, age, 0.0, -LIMITS.acceleration, LIMITS.acceleration)
    kept, A, _ = safety._rows(pairs, np.full(len(pairs.h), -1e9), -box, box)
    assert len(kept.h) == len(pairs.h)
    return kept, A


@pytest.mark.parametrize("body", [PANDA, with_prismatic_joint(PANDA)], ids=["revolute", "one prismatic"])
def test_rows_agree_with_differences_of_h_along_motions(body, rng):
    """With a vanishing period margins vanish: ḧ = A u + drift, for moving obstacles and self-collision."""
    safety = AccelerationFilter(body, AccelerationConfig(period=1e-9))
    checked = 0
    for _ in range(4):
        safety.observe(one_of_each_solid(rng))
        (q, v), u, age, eps = random_motion(rng, body), rng.uniform(-5.0, 5.0, 7), 0.02, 1e-4
        pairs, A = all_rows(safety, q, v, age)
        after, here, before = (
            safety._pairs(q + v * t + 0.5 * u * t * t, v + u * t, age + t, 0.0, -u, u) for t in (eps, 0.0, -eps)
        )
        np.testing.assert_allclose(pairs.h_dot, (after.h - before.h) / (2 * eps), atol=2e-5)
        slope, clear = (after.h_dot - before.h_dot) / (2 * eps), here.h > 0.0
        jumps = np.abs((after.h_dot - here.h_dot) - (here.h_dot - before.h_dot)) > 1e-4  # the nearest feature changed
        usable = clear & ~jumps
        np.testing.assert_allclose((A @ u + pairs.drift)[usable], slope[usable], atol=5e-3)
        checked += usable.sum()
    assert checked > 500


def test_common_motion_of_two_links_does_not_change_their_pair(rng):
    safety, q = AccelerationFilter(PANDA), np.array(PANDA.home)
    for moved in range(1, 6):  # joints 1..moved move, all others rest
        v = np.where(np.arange(7) < moved, LIMITS.velocity, 0.0)
        still, carried = (safety._pairs(q, w, 0.0, 0.0, -np.ones(7), np.ones(7)) for w in (0.0 * v, v))
        together = safety._spheres.frames[still.near_sphere] >= moved
        assert together.any()
        np.testing.assert_allclose(carried.h_dot[together], 0.0, atol=1e-9)
        np.testing.assert_allclose(carried.drift[together], still.drift[together], atol=1e-9)


def test_h_agrees_with_the_oracle(rng):
    safety = AccelerationFilter(PANDA)
    for _ in range(5):
        q, v = random_motion(rng)
        obstacles = random_scenes.random_scene(PANDA, rng, 6)
        safety.observe(obstacles)
        pairs = safety._pairs(q, v, 0.0, 0.0, -LIMITS.acceleration, LIMITS.acceleration)
        own = pairs.near_sphere >= 0
        assert pairs.h[~own].min() == pytest.approx(geometry_oracle.h_obstacles(PANDA, q[None], obstacles)[0], abs=1e-9)
        assert pairs.h[own].min() == pytest.approx(geometry_oracle.h_self(PANDA, q[None])[0], abs=1e-9)


# --- margin of the control period ---------------------------------------------------------------------------------


def test_the_margin_covers_the_period_and_is_needed(rng):
    """ψ₁(s) ≥ ψ₁ + s (A u + drift + α₁ḣ) for all s in the period and every admissible constant u, but not without m."""
    dt = 0.01
    safety = AccelerationFilter(PANDA, AccelerationConfig(period=dt))
    free = AccelerationFilter(PANDA, AccelerationConfig(period=1e-12))
    broken, a1 = 0, safety.alpha_1
    for _ in range(12):
        obstacles = one_of_each_solid(rng)
        safety.observe(obstacles)
        free.observe(obstacles)
        q, v = random_motion(rng, share=rng.uniform(0.0, 1.0))
        u = rng.choice([-1.0, 1.0], 7) * LIMITS.acceleration
        pairs, A = all_rows(safety, q, v)
        bare, _ = all_rows(free, q, v)
        psi = pairs.h_dot + a1 * pairs.h
        near = pairs.h > 0.0
        for s in (0.25 * dt, 0.5 * dt, dt):
            later, _ = all_rows(free, q + v * s + 0.5 * u * s * s, v + u * s, s)
            there = later.h_dot + a1 * later.h
            stays = near & (later.h > 0.0)
            least = psi + s * (A @ u + pairs.drift + a1 * pairs.h_dot)
            assert np.all((there - least)[stays] >= -1e-9)
            without_margin = psi + s * (A @ u + bare.drift + a1 * bare.h_dot)
            broken += np.sum((there - without_margin)[stays] < -1e-9)
    assert broken > 100


def test_culling_drops_no_row_that_can_bind(rng):
    safety = AccelerationFilter(PANDA)
    dropped = 0
    for _ in range(10):
        safety.observe(random_scenes.random_scene(PANDA, rng, 8))
        q, v = random_motion(rng, share=rng.uniform(0.0, 0.6))
        lower, upper = acceleration_box(LIMITS, q, v, safety.period, 0.05)
        pairs = safety._pairs(q, v, 0.0, 0.0, lower, upper)
        psi = pairs.h_dot + safety.alpha_1 * pairs.h
        free = pairs.drift + safety.alpha_1 * pairs.h_dot + np.where(psi < 0, 1e3, safety.config.alpha_2) * psi
        _, A, _ = safety._rows(pairs, np.full(len(free), -1e9), -np.full(7, 1e6), np.full(7, 1e6))
        can_bind = np.minimum(A * lower, A * upper).sum(axis=1) + free < 0.0
        assert safety(q, v, np.zeros(7), opening=0.0).n_rows == can_bind.sum()
        assert np.all(free[can_bind] < pairs.authority[can_bind])
        dropped += (~can_bind).sum()
    assert dropped > 1000


# --- joint limits -------------------------------------------------------------------------------------------------


@settings(max_examples=80, deadline=None)
@given(
    q=st.floats(-0.99, 0.99), v=st.floats(-2.0, 2.0), dt=st.sampled_from([1e-3, 8e-3, 0.05]), seed=st.integers(0, 9999)
)
def test_the_box_keeps_a_joint_within_its_limits_exactly(q, v, dt, seed):
    limits = msgspec.structs.replace(
        LIMITS, lower=-np.ones(1), upper=np.ones(1), velocity=np.full(1, 2.0), acceleration=np.full(1, 10.0)
    )
    v = float(np.clip(v, -np.sqrt(20.0 * (q + 1.0)), np.sqrt(20.0 * (1.0 - q))))  # the joint can stop from here
    rng, x, w = np.random.default_rng(seed), np.array([q]), np.array([v])
    for k in range(120):
        lower, upper = acceleration_box(limits, x, w, dt, 0.05)
        assert lower[0] <= upper[0]
        assert max(-lower[0], upper[0]) <= 10.0
        u = (lower, upper, upper, lower + (upper - lower) * rng.random())[k // 20 % 2 + 2 * (seed % 2)]
        if w[0] * u[0] < 0.0 and abs(w[0] / u[0]) < dt:  # the joint turns around within the step
            assert abs(x[0] - 0.5 * w[0] ** 2 / u[0]) <= 1.0 + 1e-9
        x, w = x + dt * w + 0.5 * dt * dt * u, w + dt * u
        assert abs(x[0]) <= 1.0 + 1e-9
        assert abs(w[0]) <= 2.0 + 1e-9


def test_a_joint_beyond_its_limit_returns():
    q, v, safety = np.array(PANDA.home), np.zeros(7), AccelerationFilter(PANDA)
    q[3] = LIMITS.upper[3] + 0.02
    for _ in range(500):
        answer = safety(q, v, np.where(np.arange(7) == 3, 12.0, 0.0))
        q, v = q + 1e-3 * v + 0.5e-6 * answer.u, v + 1e-3 * answer.u
        assert v[3] <= 0.0 or q[3] <= LIMITS.upper[3]
    assert abs(q[3] - LIMITS.upper[3]) <= 1e-5


# --- closed loops -------------------------------------------------------------------------------------------------


def adversary(safety, obstacles, seed, steps, q=None, hold=400):
    """Full acceleration toward one of the nearest pairs (or bang-bang): joint positions, statuses, least ψ₁."""
    rng, dt = np.random.default_rng(seed), safety.period
    safety.observe(obstacles)
    q, v = np.array(safety.robot_model.home if q is None else q, float), np.zeros(7)
    log, statuses, least = np.empty((steps, 7)), [], np.inf
    for k in range(steps):
        if k % hold == 0:
            pairs = safety._pairs(q, v, 0.0, 0.0, -LIMITS.acceleration, LIMITS.acceleration)
            near = np.flatnonzero((pairs.near_sphere >= 0) == (rng.random() < 0.3))
            chosen = rng.choice(near[np.argsort(pairs.h[near])[:150]])
            bang = rng.choice([-1.0, 1.0], 7) if rng.random() < 0.15 else None
        if k % 20 == 0:
            pairs, A = all_rows(safety, q, v)
            goal = LIMITS.velocity * (-np.sign(A[chosen]) if bang is None else bang)
        answer = safety(q, v, np.clip((goal - v) / dt, -LIMITS.acceleration, LIMITS.acceleration))
        assert np.all(np.abs(answer.u) <= LIMITS.acceleration)
        q, v = q + dt * v + 0.5 * dt * dt * answer.u, v + dt * answer.u
        log[k], least = q, min(least, answer.psi_min)
        statuses.append(answer.status)
    return log, statuses, least


def least_h(log, obstacles, robot_model=SMALL):
    return min(
        geometry_oracle.h_obstacles(robot_model, log, obstacles).min(),
        geometry_oracle.h_self(robot_model, log).min(),
        geometry_oracle.h_joints(robot_model, log).min(),
    )


def holds(body, seed, steps, count=10):
    obstacles = random_scenes.random_scene(body, np.random.default_rng(seed), count)
    log, statuses, least = adversary(AccelerationFilter(body), obstacles, seed, steps)
    assert least_h(log, obstacles, body) >= -1e-12  # a joint stops at its limit up to rounding
    assert least >= 0.0
    assert max(statuses) is FilterStatus.MODIFIED


@pytest.mark.parametrize("seed", [1, 2])
def test_no_h_below_zero(seed):
    holds(SMALL, seed, 1500)


def test_no_h_below_zero_with_every_sphere():
    holds(PANDA, 4, 500)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(10, 20))
def test_no_h_below_zero_in_a_hundred_thousand_steps(seed):
    holds(PANDA, seed, 10_000, 14)


def test_control_gains_beyond_the_acceleration_limits_fail():
    """α₁ is eight times the gain that the limits can follow at full speed, so that rows conflict too late to stop."""
    obstacles = random_scenes.random_scene(SMALL, np.random.default_rng(1), 14)
    greedy = AccelerationFilter(SMALL, AccelerationConfig(alpha_1=8.0 * PANDA.alpha, alpha_2=60.0))
    log, statuses, _ = adversary(greedy, obstacles, 1, 1000, hold=500)
    assert FilterStatus.RELAXED in statuses
    assert least_h(log, obstacles) < -1e-3


def test_control_without_a_filter_fails():
    obstacles = [TABLE]
    q, v, log = np.array(PANDA.home), np.zeros(7), []
    for _ in range(1000):
        u = np.clip(([0, 1.5, 0, 0, 0, 0, 0] - v) / 1e-3, -LIMITS.acceleration, LIMITS.acceleration)
        q, v = q + 1e-3 * v + 0.5e-6 * u, v + 1e-3 * u
        log.append(q)
    assert least_h(np.array(log), obstacles) < -0.05


def test_an_arm_at_rest_evades_a_slow_obstacle():
    """The sphere is observed every 0.1 s and moves at constant velocity in between."""
    ball = Obstacle(
        name="ball", shape=Sphere(0.08), pose=Pose((0.75, 0.0, 0.45)), velocity=(-0.2, 0.0, 0.0), static=False
    )
    safety, q, v, dt = AccelerationFilter(SMALL), np.array(PANDA.home), np.zeros(7), 1e-3
    log, shifts = [], np.zeros((1200, 1, 3))
    shifts[:, 0, 0] = -0.2 * dt * np.arange(1, 1201)
    for k in range(1200):
        if k % 100 == 0:
            seen = msgspec.structs.replace(ball, pose=Pose((0.75 - 0.2 * k * dt, 0.0, 0.45)))
            safety.observe([TABLE, seen], stamp=k * dt)
        answer = safety(q, v, -5.0 * v, now=k * dt)
        assert answer.status <= FilterStatus.MODIFIED
        q, v = q + dt * v + 0.5 * dt * dt * answer.u, v + dt * answer.u
        log.append(q)
    assert geometry_oracle.h_obstacles(SMALL, np.array(log), [ball], shifts=shifts).min() >= 0.0
    stayed = np.tile(PANDA.home, (1200, 1))
    assert geometry_oracle.h_obstacles(SMALL, stayed, [ball], shifts=shifts).min() < -0.03


# --- a start outside the safe set ---------------------------------------------------------------------------------


def rushing(speed):
    """A state too fast for α₁: the arm moves toward a wall at the fraction `speed` of its velocity limits."""
    wall = Obstacle(name="wall", shape=Box((0.02, 1.0, 1.0)), pose=Pose((0.70, 0.0, 0.5)))
    q = np.array(PANDA.home)
    _, A = all_rows(filtered(wall), q, np.zeros(7))
    pairs = filtered(wall)._pairs(q, np.zeros(7), 0.0, 0.0, -LIMITS.acceleration, LIMITS.acceleration)
    return wall, q, -speed * np.sign(A[np.argmin(np.where(pairs.near_sphere < 0, pairs.h, 9.0))]) * LIMITS.velocity


def filtered(*obstacles, robot_model=PANDA):
    safety = AccelerationFilter(robot_model)
    safety.observe(obstacles)
    return safety


def run(safety, q, v, control, steps=200):
    """Log of joint positions, and the results of the filter, under `control`(result, q, v)."""
    log, results = [], []
    for _ in range(steps):
        answer = safety(q, v, LIMITS.acceleration * np.sign(v))
        u = control(answer, q, v)
        q, v = q + 1e-3 * v + 0.5e-6 * u, v + 1e-3 * u
        log.append(q)
        results.append(answer)
    return np.array(log), results


def braking(_, q, v):
    lower, upper = acceleration_box(LIMITS, q, v, 1e-3, 0.05)
    return np.clip(-v * min(1e3, 1.0 / max(np.max(np.abs(v) / LIMITS.acceleration), 1e-12)), lower, upper)


def test_too_fast_toward_a_wall_is_reported_and_restored_no_slower_than_by_braking():
    wall, q, v = rushing(0.8)
    log, results = run(filtered(wall), q, v, lambda answer, *_: answer.u)
    assert any("'wall'" in name for name in results[0].too_fast_pairs)
    assert results[0].psi_min < 0.0 <= results[0].h_min
    assert not results[0].certified
    assert results[0].status is FilterStatus.RELAXED
    assert "too fast toward" in results[0].explain()
    restored = next(k for k, answer in enumerate(results) if not answer.too_fast_pairs)
    braked = next(k for k, answer in enumerate(run(filtered(wall), q, v, braking)[1]) if not answer.too_fast_pairs)
    assert restored <= braked
    assert not any(answer.too_fast_pairs for answer in results[restored:])
    assert all(answer.certified for answer in results[restored:])
    assert geometry_oracle.h_obstacles(PANDA, log, [wall]).min() >= 0.0


def test_no_row_is_violated_more_than_by_braking(rng):
    relaxed = 0
    for _ in range(20):
        safety = filtered(*random_scenes.random_scene(PANDA, rng, 10))
        q, v = random_motion(rng, share=0.9)
        answer = safety(q, v, rng.uniform(-1.0, 1.0, 7) * LIMITS.acceleration)
        if answer.status is not FilterStatus.RELAXED:
            continue
        relaxed += 1
        pairs, A = all_rows(safety, q, v)
        psi = pairs.h_dot + safety.alpha_1 * pairs.h
        gain = np.where(psi < 0.0, 1e3, safety.config.alpha_2)
        bound = -(pairs.drift + safety.alpha_1 * pairs.h_dot + gain * psi)
        assert np.all(A @ answer.u >= np.minimum(bound, A @ braking(None, q, v)) - 0.05)
        assert answer.active_rows
        assert answer.relaxed_ranks
    assert relaxed > 4


def test_a_start_inside_an_obstacle_is_left(rng):
    q = np.array(PANDA.home)
    centre = SphereKinematics(PANDA).motion(q, np.zeros(7), 0.0).centres[-1]
    ball = Obstacle(name="ball", shape=Sphere(0.03), pose=Pose((*centre[:2], centre[2] - 0.03)))
    log, results = run(filtered(ball), q, np.zeros(7), lambda answer, *_: answer.u, 400)
    h = geometry_oracle.h_obstacles(PANDA, log, [ball])
    assert h[0] < 0.0 <= h[-1]
    assert any("'ball'" in name for name in results[0].penetrating_pairs)
    assert "already inside" in results[0].explain()
    assert np.all(np.diff(h[h < 0.0]) >= -1e-9)


# --- safe input and invalid input ---------------------------------------------------------------------------------


def test_a_strictly_safe_control_is_returned_bit_for_bit(rng):
    safety = filtered(TABLE)
    for _ in range(20):
        u = 0.1 * rng.uniform(-1.0, 1.0, 7)
        answer = safety(np.array(PANDA.home), np.zeros(7), u)
        assert answer.status is FilterStatus.SAFE
        assert np.array_equal(answer.u, u)
        assert answer.delta == 0.0
        assert answer.certified


def test_a_result_passes_unchanged(rng):
    safety = filtered(*random_scenes.random_scene(PANDA, rng, 8))
    for _ in range(20):
        q, v = random_motion(rng, share=0.15)
        first = safety(q, v, rng.uniform(-1.0, 1.0, 7) * LIMITS.acceleration)
        if first.status is FilterStatus.MODIFIED:
            np.testing.assert_allclose(safety(q, v, first.u).u, first.u, atol=1e-6)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_input_that_is_not_finite_brakes(bad):
    safety, q, v = filtered(TABLE), np.array(PANDA.home), np.full(7, 0.5)
    safety(q, v, np.zeros(7))
    for place in range(3):
        given = [q.copy(), v.copy(), np.zeros(7)]
        given[place][2] = bad
        answer = safety(*given)
        assert answer.status is FilterStatus.STOPPED
        assert answer.reason is Reason.BAD_INPUT
        assert np.isfinite(answer.u).all()
        assert np.all(answer.u < 0.0)  # the arm brakes from the last valid velocity
    assert safety(q, v, np.zeros(7), now=bad).status is FilterStatus.STOPPED


def test_without_a_velocity_it_brakes_until_the_expected_standstill():
    safety, v = filtered(TABLE), np.full(7, 0.3)
    safety(np.array(PANDA.home), v, np.zeros(7))
    for _ in range(200):
        v = v + 1e-3 * safety(np.full(7, np.nan), np.full(7, np.nan), np.zeros(7)).u
    np.testing.assert_allclose(v, 0.0, atol=1e-9)


def test_an_invalid_or_stale_scene_stops():
    q, v = np.array(PANDA.home), np.zeros(7)
    safety = filtered()
    with pytest.raises(GeometryError):
        safety.observe([Obstacle(name="x", shape=Sphere(np.nan), pose=Pose((1, 1, 1)))])
    assert safety(q, v, v).reason is Reason.BAD_SCENE
    safety = filtered(Obstacle(name="x", shape=Sphere(0.1), pose=Pose((1, 1, 1)), static=False))
    assert safety(q, v, v, now=0.4).status is FilterStatus.SAFE
    assert safety(q, v, v, now=0.6).reason is Reason.STALE_SCENE
    q[0] = LIMITS.upper[0] + 0.3
    assert filtered()(q, v, v).reason is Reason.OUTSIDE_LIMITS


def test_an_obstacle_may_apply_to_some_parts_and_have_its_own_gain():
    obstacles = [Obstacle(name="wall", shape=Box((0.02, 1, 1)), pose=Pose((0.8, 0, 0.5)), parts=("hand",), alpha=1.5)]
    safety = filtered(*obstacles)
    pairs = safety._pairs(np.array(PANDA.home), np.zeros(7), 0.0, 0.0, -LIMITS.acceleration, LIMITS.acceleration)
    wall = pairs.near_sphere < 0
    assert {safety._spheres.names[k] for k in pairs.sphere[wall]} == {"hand"}
    assert set(pairs.alpha_1[wall]) == {1.5}


def test_invalid_configurations_state_the_reason():
    with pytest.raises(UnknownNameError):
        filtered(Obstacle(name="x", shape=Sphere(0.1), pose=Pose((1, 1, 1)), parts=("tail",)))
    with pytest.raises(ConfigurationError, match="SafetyFilter"):
        filtered(Obstacle(name="x", shape=Sphere(0.1), pose=Pose((1, 1, 1)), separation=SpeedAndSeparation()))
    with pytest.raises(ConfigurationError, match="gains"):
        AccelerationFilter(PANDA, AccelerationConfig(alpha_2=2000.0))
    with pytest.raises(ConfigurationError, match="fixed"):
        AccelerationFilter(msgspec.structs.replace(PANDA, base="differential"))
    with pytest.raises(ConfigurationError, match="7 numbers"):
        filtered()(np.zeros(6), np.zeros(7), np.zeros(7))
