"""Laws of the filter: safe controls pass, others are changed least, invalid input stops, contact needs a permit."""

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dualbrain.core.geometry.rotations import rotation_error
from dualbrain.core.geometry.shapes import Box, HalfSpace, Pose, Sphere
from dualbrain.errors import ConfigurationError, GeometryError, UnknownNameError
from dualbrain.robots.loader import load_robot
from dualbrain.safety.cbf.filter import Contact, FilterStatus, Obstacle, SafetyFilter
from dualbrain.safety.cbf.kernel import kernel_hash
from dualbrain.safety.cbf.result import OBSTACLE, PACKED_ROW, REASON_TEXTS, SELF, Reason
from tests.safety import random_scenes

TABLE = Obstacle("table", HalfSpace(), Pose((0.0, 0.0, 0.0)), known=True)
PANDA = load_robot("panda")


@pytest.fixture
def safety(panda):
    made = SafetyFilter(panda, random_scenes.exact_config())
    made.observe([TABLE], 0.0)
    return made


def drive(safety, at, q, nominal, steps, t=0.0):
    """Closed loop with u_nom = nominal(q); returns the final q and the results."""
    answers = []
    for k in range(steps):
        now = t + k * 1e-3
        answers.append(safety.filter(at(q, t=now), nominal(q), now))
        q = q + 1e-3 * answers[-1].u
    return q, answers


def toward(safety, direction, speed):
    return lambda q: np.linalg.pinv(safety.tool(q).jacobian) @ np.array([*(speed * np.array(direction)), 0, 0, 0])


def straight(safety, goal, speed, rotation):
    """Nominal control that keeps the rotation and moves straight to `goal` at up to `speed`."""

    def nominal(q):
        tool = safety.tool(q)
        way = 4.0 * (goal - tool.position)
        way *= min(1.0, speed / max(np.linalg.norm(way), 1e-9))
        return np.linalg.pinv(tool.jacobian) @ np.concatenate([way, 4.0 * rotation_error(tool.rotation, rotation)])

    return nominal


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**31))
def test_a_strictly_safe_nominal_passes_bit_identical(seed):
    rng = np.random.default_rng(seed)
    safety = SafetyFilter(PANDA, random_scenes.exact_config())
    safety.observe([TABLE], 0.0)
    step = np.array([j.acceleration.value for j in PANDA.joints]) * 1e-3
    u_nom = rng.uniform(-0.99, 0.99, 7) * step
    q = np.array(PANDA.home) + rng.uniform(-0.05, 0.05, 7)
    state = type("S", (), {"q": q, "v": np.zeros(7), "opening": 0.02, "stamp": 0.0})()
    answer = safety.filter(state, u_nom, 0.0)
    if answer.h_min > 0.005:
        assert np.array_equal(answer.u, u_nom.astype(np.float32).astype(np.float64))
        assert (answer.delta, answer.status, answer.certified) == (0.0, FilterStatus.SAFE, True)


def test_a_safe_control_passes_unchanged(sparse_panda, state_at):
    for seed in range(3):
        obstacles = random_scenes.random_scene(sparse_panda, np.random.default_rng(seed))
        safety, again = (SafetyFilter(sparse_panda, random_scenes.exact_config()) for _ in range(2))
        safety.observe(obstacles, 0.0)
        again.observe(obstacles, 0.0)
        run = random_scenes.closed_loop(safety, sparse_panda.home, 1500, seed)
        for k in range(100, 1500, 70):
            u_prev, q, desired = run.u[k - 1], run.q[k - 1], np.sign(run.u[k]) * 2.0
            safety.reset(u_prev)
            again.reset(u_prev)
            once = safety.filter(state_at(q), desired, 0.0)
            twice = again.filter(state_at(q), once.u, 0.0)
            np.testing.assert_allclose(twice.u, once.u, atol=2e-6)
            assert twice.delta < 1e-6


@pytest.mark.parametrize("unknown", [np.nan, np.inf, -np.inf])
def test_an_unknown_last_control_is_that_of_an_arm_at_rest(sparse_panda, state_at, unknown):
    q, answers = np.array(sparse_panda.home), []
    for start in (0.0, unknown):
        safety = SafetyFilter(sparse_panda, random_scenes.exact_config())
        safety.reset(np.where(np.arange(7) == 2, start, 0.0), np.where(np.arange(7) == 3, start, 0.0))
        answers.append(safety.filter(state_at(q), np.full(7, 0.3), 0.0))
    np.testing.assert_array_equal(answers[0].u, answers[1].u)
    assert answers[1].status <= FilterStatus.MODIFIED


def test_answers_are_admissible_and_certified(sparse_panda, state_at):
    rng = np.random.default_rng(0)
    obstacles = random_scenes.random_scene(sparse_panda, rng)
    safety = SafetyFilter(sparse_panda, random_scenes.exact_config())
    safety.observe(obstacles, 0.0)
    v_max = np.array([j.velocity.value for j in sparse_panda.joints])
    step = np.array([j.acceleration.value for j in sparse_panda.joints]) * 1e-3
    q, before = np.array(sparse_panda.home), np.zeros(7)
    for k in range(1500):
        if k % 150 == 0:
            desired = rng.choice([-1.0, 1.0], 7) * v_max
        answer = safety.filter(state_at(q), desired, 0.0)
        assert answer.status in (FilterStatus.SAFE, FilterStatus.MODIFIED)
        assert answer.certified
        assert np.all(np.abs(answer.u) <= v_max)
        assert np.all(np.abs(answer.u - before) <= step * (1 + 1e-5) + 1e-7)
        q, before = q + 1e-3 * answer.u, answer.u


def test_the_table_stops_the_tool_and_the_reason_is_named(safety, panda, state_at):
    _, answers = drive(safety, state_at, np.array(panda.home), toward(safety, (0, 0, -1), 0.3), 2500)
    last = answers[-1]
    assert last.status is FilterStatus.MODIFIED
    assert min(a.h_min for a in answers) > 0.0
    assert any("table" in name for name, _, _ in last.active_rows)
    assert "'table'" in last.explain()
    assert last.delta == pytest.approx(last.delta_rows + last.delta_box)


def test_the_pairs_of_the_binding_rows_are_those_with_obstacles_the_strongest_first(safety, panda, state_at):
    result = drive(safety, state_at, np.array(panda.home), lambda q: 0.0 * q, 1)[1][0]
    assert result.obstacle_pairs == ()
    rows = ((OBSTACLE, 0, 0, 0.2, 1.0), (SELF, 0, 9, 0.3, 9.0), (OBSTACLE, len(panda.spheres) - 1, 0, 0.1, 3.0))
    bound = msgspec.structs.replace(result, packed_rows=b"".join(PACKED_ROW.pack(*row) for row in rows))
    first, last = result.names.spheres[0], result.names.spheres[-1]
    assert bound.obstacle_pairs == ((last, "table", 0.1), (first, "table", 0.2))


def test_delta_is_the_weighted_distance(safety, panda, state_at):
    u_nom = np.full(7, 2.0)
    answer = safety.filter(state_at(panda.home), u_nom, 0.0)
    v_max = np.array([j.velocity.value for j in panda.joints])
    assert answer.delta == pytest.approx(np.sqrt(np.mean(((answer.u - u_nom) / v_max) ** 2)), rel=1e-5)
    assert answer.delta_box > 0.95 * answer.delta  # a jump that φ could not have followed either


def test_projection_of_a_known_scene_passes_the_filter(panda, state_at):
    safety = SafetyFilter(panda, random_scenes.exact_config(lag_compensation=True))
    wall = Obstacle("wall", Box((0.02, 0.5, 0.5)), Pose((0.6, 0.0, 0.5)), known=True)
    safety.observe([TABLE, wall], 0.0)
    q, v, u_nom = np.array(panda.home), np.zeros(7), np.zeros(7)
    rng = np.random.default_rng(1)
    near = np.inf
    for k in range(4000):
        if k % 500 == 0:
            desired = toward(safety, rng.normal(size=3), 0.4)
        state = state_at(q, v, t=k * 1e-3)
        u_nom = safety.project(state, desired(q), u_nom, k * 1e-3)
        answer = safety.filter(state, u_nom, k * 1e-3)
        assert np.array_equal(answer.u, u_nom)
        assert answer.delta == 0.0
        near = min(near, answer.h_min)
        v = v + (answer.u - v) * 1e-3 / panda.tracking.lag
        q = q + 1e-3 * v
    assert 0.0 < near < 0.01


def test_projection_ignores_unknown_obstacles(panda, state_at):
    safety = SafetyFilter(panda, random_scenes.exact_config())
    tool = safety.tool(np.array(panda.home)).position
    ball = Obstacle("ball", Sphere(0.03), Pose(tuple(tool + np.array([0.1, 0.0, 0.0]))))
    safety.observe([ball], 0.0)
    q, u_nom, deltas = np.array(panda.home), np.zeros(7), []
    for _ in range(1200):
        u_nom = safety.project(state_at(q), toward(safety, (1, 0, 0), 0.2)(q), u_nom, 0.0)
        answer = safety.filter(state_at(q), u_nom, 0.0)
        deltas.append(answer.delta)
        q = q + 1e-3 * answer.u
    assert max(deltas) > 0.01
    assert answer.h_min >= 0.0


def test_a_grasp_is_stopped_without_a_permit_and_slow_with_one(panda, state_at):
    safety = SafetyFilter(panda, random_scenes.exact_config())
    q0 = np.array(panda.home)
    tool = safety.tool(q0)
    obstacle = Obstacle("cube", Box((0.02, 0.04, 0.02)), Pose(tuple(tool.position + 0.12 * tool.rotation[:, 2])))
    safety.observe([obstacle], 0.0)
    goal = np.array(obstacle.pose.position)
    ahead = straight(safety, goal, 0.05, tool.rotation)
    q, answers = drive(safety, state_at, q0, ahead, 4000)
    assert min(a.h_min for a in answers) >= 0.0
    assert np.linalg.norm(safety.tool(q).position - goal) > 0.02
    # the same with a permit: fingers and hand may touch at 2 cm/s
    safety.permit([Contact("fingers", "cube", 0.02), Contact("hand", "cube", 0.02)])
    q, _ = drive(safety, state_at, q0, ahead, 6000)
    assert np.linalg.norm(safety.tool(q).position - goal) < 0.004, "with a permit the tool reaches the cube"
    # after the permit the rows apply again, and the arm must move away
    safety.permit([])
    back = safety.filter(state_at(q), ahead(q), 0.0)
    assert back.h_min < 0.0
    assert back.status is not FilterStatus.SAFE


def test_contact_speed_is_kept_at_contact(panda, state_at):
    safety = SafetyFilter(panda, random_scenes.exact_config())
    q = np.array(panda.home)
    tool = safety.tool(q).position
    height, touching = float(tool[2]) - 0.06, 0
    pad = Pose((float(tool[0]), float(tool[1]), height - 0.05))
    safety.observe([Obstacle("pad", Box((0.15, 0.15, 0.05)), pad)], 0.0)
    safety.permit([Contact("fingers", "pad", 0.03), Contact("hand", "pad", 0.03)])
    for _ in range(2000):
        answer = safety.filter(state_at(q), toward(safety, (0, 0, -1), 0.3)(q), 0.0)
        before, radii, groups = safety.spheres(q, 0.04)
        q = q + 1e-3 * answer.u
        speed = (before - safety.spheres(q, 0.04)[0])[:, 2] / 1e-3
        near = (before[:, 2] - radii - height < 1e-3) & np.isin(groups, ("hand", "fingers"))
        touching += np.any(near)
        assert np.all(speed[near] < 0.03 + 1e-3)
    assert touching > 30


@pytest.mark.parametrize("real", ["float32", "float64"])
def test_recovers_from_inside_an_obstacle(panda, state_at, real):
    safety = SafetyFilter(panda, random_scenes.exact_config(precision=real))
    q = np.array(panda.home)
    tool = safety.tool(q).position
    safety.observe([Obstacle("ball", Sphere(0.05), Pose(tuple(tool + np.array([0.07, 0.0, 0.08]))))], 0.0)
    _, answers = drive(safety, state_at, q, lambda q: np.zeros(7), 4000)
    h = np.array([a.h_min for a in answers])
    assert h[0] < -0.005
    assert np.all(np.diff(h) > -1e-6)
    assert h[-1] > -1e-3
    assert all(a.status in (FilterStatus.MODIFIED, FilterStatus.RELAXED, FilterStatus.SAFE) for a in answers)


def test_moving_away_is_never_forbidden(panda, state_at):
    safety = SafetyFilter(panda, random_scenes.exact_config())
    q = np.array(panda.home)
    tool = safety.tool(q).position
    safety.observe([Obstacle("ball", Sphere(0.04), Pose(tuple(tool + np.array([0.05, 0.0, 0.0]))))], 0.0)
    speed = []
    for _ in range(400):
        answer = safety.filter(state_at(q), toward(safety, (-1, 0, 0), 0.3)(q), 0.0)
        speed.append((safety.tool(q).jacobian @ answer.u)[0])
        q = q + 1e-3 * answer.u
    assert min(speed) < -0.25


def test_bad_input_stops_within_the_acceleration_box(safety, panda, state_at):
    step = np.array([j.acceleration.value for j in panda.joints]) * 1e-3
    nan, good = np.full(7, np.nan), np.array(panda.home)
    u_prev = np.array([0.5, -0.3, 0.2, 0.0, 0.1, 0.4, -1.0])
    outside = good.copy()
    outside[3] = 1.0
    cases = {
        Reason.BAD_INPUT: [
            (state_at(nan), np.zeros(7), 0.0),
            (state_at(good, nan), np.zeros(7), 0.0),
            (state_at(good), nan, 0.0),
            (state_at(good, opening=np.inf), np.zeros(7), 0.0),
        ],
        Reason.STALE_STATE: [
            (state_at(good, t=0.0), np.zeros(7), 0.2),
            (state_at(good, t=0.3), np.zeros(7), 0.2),
            (state_at(good, t=0.0), np.zeros(7), np.nan),
        ],
        Reason.OUTSIDE_LIMITS: [(state_at(outside), np.zeros(7), 0.0)],
    }
    for reason, inputs in cases.items():
        for state, u_nom, now in inputs:
            safety.reset(u_prev)
            answer = safety.filter(state, u_nom, now)
            assert answer.status is FilterStatus.STOPPED
            assert reason in answer.reason
            assert not answer.certified
            assert np.all(np.isfinite(answer.u))
            assert np.all(np.abs(answer.u - u_prev) <= step * 1.0001)
            assert np.all(np.abs(answer.u) <= np.abs(u_prev))
            assert np.isfinite(answer.delta)
            assert REASON_TEXTS[reason.name] in answer.explain()


def test_moving_obstacles_go_stale_and_static_ones_do_not(safety, panda, state_at):
    ball = Obstacle("ball", Sphere(0.05), Pose((2.0, 0.0, 0.5)), velocity=(0.1, 0.0, 0.0), static=False)
    state = state_at(panda.home, t=1.0)
    safety.observe([TABLE], 0.0)
    assert safety.filter(state, np.zeros(7), 1.0).status is FilterStatus.SAFE
    safety.observe([TABLE, ball], 0.0)
    assert Reason.STALE_SCENE in safety.filter(state, np.zeros(7), 1.0).reason
    safety.observe([TABLE, ball], 0.8)
    assert safety.filter(state, np.zeros(7), 1.0).status is FilterStatus.SAFE


def test_obstacles_are_carried_forward_and_grow_with_age(panda, state_at):
    safety = SafetyFilter(panda, random_scenes.exact_config())
    tool = safety.tool(np.array(panda.home)).position
    place = tuple(tool + np.array([0.3, 0.0, 0.0]))
    moving = Obstacle("m", Sphere(0.05), Pose(place), velocity=(-0.2, 0.0, 0.0), velocity_error=0.1, static=False)
    safety.observe([moving], 0.0)
    early = safety.filter(state_at(panda.home, t=0.0), np.zeros(7), 0.0).h_min
    safety.reset()
    moved = Obstacle("m", Sphere(0.05), Pose((place[0] - 0.08, *place[1:])), margin=0.04)
    late = safety.filter(state_at(panda.home, t=0.4), np.zeros(7), 0.4).h_min
    safety.reset()
    safety.observe([moved], 0.0)
    assert late == pytest.approx(safety.filter(state_at(panda.home), np.zeros(7), 0.0).h_min, abs=1e-5)
    assert late <= early


def test_a_scene_with_a_number_that_is_not_finite_stops(safety, panda, state_at):
    with pytest.raises(GeometryError, match="position of pose of obstacle 'ghost'"):
        safety.observe([Obstacle("ghost", Sphere(0.05), Pose((np.nan, 0.0, 0.5)))], 0.0)
    answer = safety.filter(state_at(panda.home), np.zeros(7), 0.0)
    assert answer.status is FilterStatus.STOPPED
    assert Reason.BAD_SCENE in answer.reason


def test_two_obstacles_closing_in_are_reported_as_conflicting(panda, state_at):
    safety = SafetyFilter(panda, random_scenes.exact_config())
    tool = safety.tool(np.array(panda.home)).position
    pair = [
        Obstacle(
            side,
            Sphere(0.05),
            Pose(tuple(tool + np.array([0.0, sign * 0.2, 0.0]))),
            velocity=(0.0, -sign * 0.8, 0.0),
            static=False,
        )
        for side, sign in (("left", 1.0), ("right", -1.0))
    ]
    safety.observe(pair, 0.0)
    answer = safety.filter(state_at(panda.home), np.zeros(7), 0.0)
    assert answer.status in (FilterStatus.RELAXED, FilterStatus.FAULT)
    assert Reason.INFEASIBLE in answer.reason
    assert len(answer.active_rows) >= 2
    assert all(weight >= -1e-6 for _, _, weight in answer.active_rows)


def test_the_arm_yields_to_an_approaching_obstacle(panda, state_at):
    safety = SafetyFilter(panda, random_scenes.exact_config())
    q = np.array(panda.home)
    place = safety.tool(q).position + np.array([0.35, 0.0, 0.0])
    least = np.inf
    for k in range(2500):
        x = place - np.array([0.1 * k * 1e-3, 0.0, 0.0])
        safety.observe(
            [Obstacle("cart", Sphere(0.05), Pose(tuple(x)), velocity=(-0.1, 0.0, 0.0), static=False)], k * 1e-3
        )
        answer = safety.filter(state_at(q, t=k * 1e-3), np.zeros(7), k * 1e-3)
        least = min(least, answer.h_min)
        q = q + 1e-3 * answer.u
    assert least >= 0.0


def test_a_base_on_a_table_and_a_mount_do_not_stop_the_robot(panda, state_at):
    safety = SafetyFilter(panda, random_scenes.exact_config())
    plate = Obstacle("plate", Box((0.2, 0.2, 0.05)), Pose((0.0, 0.0, -0.02)))
    safety.observe([TABLE, plate], 0.0)
    answer = safety.filter(state_at(panda.home), np.zeros(7), 0.0)
    assert answer.status is FilterStatus.SAFE


def test_an_obstacle_around_the_arm_that_no_joint_can_leave_stops(panda, state_at):
    safety = SafetyFilter(panda, random_scenes.exact_config())
    safety.observe([Obstacle("block", Box((0.3, 0.3, 0.6)), Pose((0.0, 0.0, 0.6)), static=False)], 0.0)
    answer = safety.filter(state_at(panda.home), np.full(7, 0.01), 0.0)
    assert answer.status in (FilterStatus.STOPPED, FilterStatus.FAULT, FilterStatus.RELAXED)
    assert not np.array_equal(answer.u, np.full(7, 0.01))


def test_held_objects_keep_away_from_obstacles_and_from_the_arm(panda, state_at):
    safety = SafetyFilter(panda, random_scenes.exact_config())
    safety.observe([TABLE], 0.0)
    bare = safety.filter(state_at(panda.home), np.zeros(7), 0.0).h_min
    safety.attach(np.array([[0.0, 0.0, 0.38, 0.02]]), 0.0)
    assert safety.filter(state_at(panda.home), np.zeros(7), 0.0).h_min < bare
    _, answers = drive(safety, state_at, np.array(panda.home), toward(safety, (0, 0, -1), 0.2), 1500)
    assert min(a.h_min for a in answers) >= 0.0
    assert any(name.startswith("held") for name, _, _ in answers[-1].active_rows)
    safety.detach()
    assert safety.filter(state_at(panda.home), np.zeros(7), 0.0).h_min == bare


def test_invalid_calls_raise_errors(safety):
    with pytest.raises(UnknownNameError, match="fingers"):
        safety.permit([Contact("finger", "cup", 0.1)])
    with pytest.raises(ConfigurationError):
        safety.permit([Contact("fingers", "cup", float("nan"))])
    with pytest.raises(ConfigurationError):
        safety.attach(np.zeros((9, 4)), 0.0)
    with pytest.raises(ConfigurationError):
        safety.observe([TABLE] * 513, 0.0)
    with pytest.raises(ConfigurationError):
        SafetyFilter(PANDA, weight=-np.eye(7))


def test_an_obstacle_gain_beyond_the_tracking_margin_is_rejected(panda):
    """Rows cover the tracking error up to the gain of the filter; a larger gain would not be covered."""
    steep = Obstacle("wall", Box((0.02, 1, 1)), Pose((0.8, 0, 0.5)), alpha=panda.alpha * 1.01)
    with pytest.raises(ConfigurationError, match="'wall'"):
        SafetyFilter(panda).observe([steep])
    SafetyFilter(panda).observe([Obstacle("wall", steep.shape, steep.pose, alpha=panda.alpha)])
    SafetyFilter(panda, random_scenes.exact_config(tracking_error=0.01)).observe([steep])


def test_a_permit_for_a_missing_obstacle_has_no_effect(safety, panda, state_at):
    safety.permit([Contact("fingers", "gone", 0.1)])
    _, answers = drive(safety, state_at, np.array(panda.home), toward(safety, (0, 0, -1), 0.3), 1500)
    assert min(a.h_min for a in answers) >= 0.0


def test_unfiltered_is_the_nominal(safety, panda, state_at):
    u_nom = np.full(7, 1.0)
    bare = safety.filter(state_at(panda.home), u_nom, 0.0).unfiltered()
    assert np.array_equal(bare.u, u_nom)
    assert (bare.delta, bare.certified) == (0.0, False)


def test_a_general_weight_changes_the_result(panda, state_at):
    weight = np.diag([100.0, 1, 1, 1, 1, 1, 1])
    plain, other = (
        SafetyFilter(panda, random_scenes.exact_config()),
        SafetyFilter(panda, random_scenes.exact_config(), weight=weight),
    )
    ends = []
    for safety in (plain, other):
        safety.observe([TABLE], 0.0)
        ends.append(drive(safety, state_at, np.array(panda.home), toward(safety, (0.3, 0.3, -1), 0.3), 1500)[0])
    assert np.max(np.abs(ends[0] - ends[1])) > 1e-3


def test_the_kernel_has_a_hash():
    assert len(kernel_hash()) == 16
