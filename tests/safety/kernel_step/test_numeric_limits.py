"""Numeric limits of the kernel: capacities, tolerances and thresholds, tested just below and just above."""

import math

import numpy as np
import pytest

from dualbrain.safety.cbf.compiled import _kernel, _kernel64
from tests.safety.kernel_step import random_cases
from tests.safety.kernel_step.reference_obstacles import ReferenceObstacle

MARGIN, ERROR, REACTION, BRAKE, APPROACH, ALPHA, RANK, SHAPE, RADIUS = 24, 25, 26, 27, 28, 4, 2, 0, 20
STATUS_STOPPED, OVERFLOW, BAD_SCENE, INFEASIBLE, JERK = 3, 16, 256, 128, 2048
NO_GRADIENT, UNAVOIDABLE = 32, 1024
VELOCITY, ACCELERATION, JERKED, AT_LIMIT = range(4)


def chain_model(n=2, spheres=(), frames=(2,), counts=(1,), **changes):
    """An arm of `n` joints about parallel axes, 0.3 m apart, at home, with a sphere on its last frame."""
    sphere_table = np.array(spheres or [[0.1, 0.0, 0.0, 0.02, 0.0, 0.0, 0.0]] * sum(counts), float)
    return {
        "n": n,
        "period": 1e-3,
        "alpha": 4.0,
        "alpha_self": 4.0,
        "alpha_joint": 4.0,
        "recovery": 0.05,
        "sampling": 0.0,
        "rounding": 0.0,
        "self_margin": 0.0,
        "lag": 0.0,
        "speed_limit": 0.0,
        "moving_base": 0.0,
        "speed_first_joint": 0.0,
        "state_age_max": 0.05,
        "scene_age_max": 0.5,
        "joint_kind": np.zeros(n),
        "joint_rotation": np.tile(np.eye(3).ravel(), n),
        "joint_offset": np.tile([0.3, 0.0, 0.0], n),
        "q_lower": np.full(n, -2.0),
        "q_upper": np.full(n, 2.0),
        "v_max": np.full(n, 2.0),
        "a_max": np.full(n, 10.0),
        "j_max": np.zeros(n),
        "tracking": np.zeros(n),
        "scale": np.eye(n),
        "tool_rotation": np.eye(3).ravel(),
        "tool_offset": np.zeros(3),
        "link_frame": np.array(frames, float),
        "link_first": np.concatenate([[0.0], np.cumsum(counts)]).astype(float),
        "spheres": sphere_table,
        "pairs": np.zeros(0),
        "held_links": np.zeros(0),
    } | changes


def ball_row(position=(5.0, 5.0, 5.0), radius=0.05, **changes):
    """One static sphere as a row of the table; `changes` by column."""
    row = [
        0.0,
        2.0,
        2.0,
        random_cases.ALL_LINKS_MASK,
        0.0,
        *position,
        *np.eye(3).ravel(),
        0.0,
        0.0,
        0.0,
        radius,
        *[0.0] * 8,
    ]
    for column, value in changes.items():
        row[int(column[1:])] = value
    return row


def answer(model, obstacles=(), q=0.0, u_prev=0.0, u_nom=None, before=None, build=_kernel64):
    """The kernel and its result after one step from rest or from `u_prev`."""
    n, made = model["n"], random_cases.make_kernel(model, build)
    made.set_obstacles(np.array(obstacles, float).reshape(-1, 29))
    last = np.broadcast_to(np.asarray(u_prev, float), (n,)).copy()
    made.reset(last, np.zeros_like(last))
    m = random_cases.StepCase(
        np.broadcast_to(q, (n,)).astype(float),
        np.zeros(n),
        last if u_nom is None else np.asarray(u_nom, float),
        last,
        np.empty((0, 29)),
    )
    if before is not None:  # a step that sets the change of the last control
        m.u_nom = np.asarray(before, float)
        random_cases.run_step(made, m)
        m.u_nom = np.asarray(u_nom, float)
    return made, random_cases.run_step(made, m)


@pytest.mark.parametrize(("links", "obstacles"), [(8, 64), (64, 8)], ids=["many obstacles", "many spheres"])
def test_512_rows_fit_and_one_more_stops_the_robot(links, obstacles):
    """All spheres are within 1 mm of all obstacles: 512 rows are posed, 513 are reported as too many."""
    model = chain_model(frames=(1, 2), counts=(1, links))
    around = ball_row((0.7, 0.15, 0.0), 0.1, **{"c3": 2.0, f"c{MARGIN}": 0.0295})
    first = ball_row((0.4, 0.15, 0.0), 0.1, **{"c3": 1.0, f"c{MARGIN}": 0.0295})
    made, fits = answer(model, [around] * obstacles)
    assert (fits.flags & OVERFLOW, random_cases.step_internals(made, 2, 2)["rows"]["count"][0]) == (0, 512)
    made, many = answer(model, [*[around] * obstacles, first])
    assert (many.status, many.flags & OVERFLOW) == (STATUS_STOPPED, OVERFLOW)
    assert (many.n_rows, many.certified, many.iterations, many.binding_rows, many.relaxed_mask) == (
        512,
        False,
        0,
        (),
        0,
    )
    assert many.h_min == pytest.approx(0.0005, abs=1e-12)


def test_user_rows_count_toward_the_capacity():
    model = chain_model(frames=(1, 2), counts=(1, 8))
    made = random_cases.make_kernel(model)
    made.set_obstacles(np.array([ball_row((0.7, 0.15, 0.0), 0.1, **{"c3": 2.0, f"c{MARGIN}": 0.0295})] * 64))
    m = random_cases.StepCase(*np.zeros((4, 2)), np.empty((0, 29)))
    for rows, expected in ((0, 0), (1, OVERFLOW)):
        made.constrain(np.array([[1.0, 0.0, -5.0, 0.0, 1.0]] * rows).reshape(-1, 5))
        assert random_cases.run_step(made, m).flags & OVERFLOW == expected


def test_inside_a_box_the_way_out_is_the_nearest_face():
    rng = np.random.default_rng(8)
    for _ in range(60):
        row = np.array(ball_row((0.1, 0.2, 0.3), 0.0))
        row[0], row[8:17], row[17:20] = 1.0, random_cases.random_rotation(rng).ravel(), rng.uniform(0.1, 0.4, 3)
        obstacle = ReferenceObstacle(row, 0.0)
        points = row[5:8] + (rng.uniform(-1.0, 1.0, (8, 3)) * obstacle.half) @ obstacle.rotation.T
        d, n = np.empty(8), np.empty((8, 3))
        _kernel64.distance(row, np.ascontiguousarray(points), d, n)
        for point, got, normal in zip(points, d, n, strict=True):
            expected, way = obstacle.distance(point)
            assert expected < 0.0
            assert got == pytest.approx(expected, abs=1e-12)
            np.testing.assert_allclose(normal, way, atol=1e-12)


RANGES = {
    "alpha": (ALPHA, 0.0, 1e6),
    "reaction": (REACTION, 0.0, 1e3),
    "brake": (BRAKE, 0.0, 1e6),
    "approach": (APPROACH, 0.0, 1e3),
    "rank": (RANK, 1.0, 4.0),
    "shape": (SHAPE, 0.0, 2.0),
    "radius": (RADIUS, 0.0, math.inf),
    "velocity error": (ERROR, 0.0, math.inf),
}


@pytest.mark.parametrize("name", RANGES)
def test_obstacle_values_are_accepted_up_to_the_ends_of_their_ranges(name):
    column, low, high = RANGES[name]
    inside = [low, 0.5 * low + 0.5 * high if math.isfinite(high) else 7.0, high if math.isfinite(high) else 1e5]
    whole = name in ("rank", "shape")
    outside = [
        low - (1.0 if whole else 1e-3),
        high + 1.0 if whole else (1.01 * high if math.isfinite(high) else high),
        math.nan,
    ]
    for value in inside:
        _, got = answer(chain_model(), [ball_row(), ball_row(**{f"c{column}": math.floor(value) if whole else value})])
        assert not got.flags & BAD_SCENE, value
    for value in outside[: 2 if whole else 3]:
        _, got = answer(chain_model(), [ball_row(), ball_row(**{f"c{column}": value})])
        assert got.flags & BAD_SCENE, value
        assert got.status == STATUS_STOPPED


@pytest.mark.parametrize(
    ("frame", "still", "expected"),
    [(1, True, 0), (1, False, UNAVOIDABLE), (2, True, UNAVOIDABLE), (2, False, UNAVOIDABLE)],
)
def test_only_the_mount_may_be_close_to_an_unavoidable_static_obstacle(frame, still, expected):
    """A sphere on the axes of all joints does not move. Deeper than the sampling margin the robot stops."""
    spheres = [[0.0, 0.0, 0.1, 0.02, 0.0, 0.0, 0.0]]
    model = chain_model(spheres=spheres, frames=(frame,), joint_offset=np.zeros(6), sampling=1e-3)
    for deep, more in ((0.5e-3, 0), (1.5e-3, NO_GRADIENT)):
        near = ball_row((0.0, 0.071 - deep, 0.1), **{"c1": 2.0 * still})
        _, got = answer(model, [near])
        assert got.flags & (NO_GRADIENT | UNAVOIDABLE) == (expected | more if expected else 0)
        assert (got.status == STATUS_STOPPED) == bool(expected and more)


@pytest.mark.parametrize("column", [*range(5, 26)])
def test_no_number_of_an_obstacle_may_be_infinite(column):
    for value in (math.inf, -math.inf, math.nan):
        _, got = answer(chain_model(), [ball_row(**{f"c{column}": value})])
        assert got.flags & BAD_SCENE


def test_user_rows_need_a_valid_rank():
    for rank, bad in ((0.0, True), (1.0, False), (4.0, False), (5.0, True)):
        made = random_cases.make_kernel(chain_model())
        made.constrain(np.array([[1.0, 0.0, -5.0, 0.0, 1.0], [1.0, 0.0, -5.0, 0.0, rank]]))
        m = random_cases.StepCase(*np.zeros((4, 2)), np.empty((0, 29)))
        assert bool(random_cases.run_step(made, m).flags & BAD_SCENE) == bad


def test_a_new_kernel_has_an_empty_scene():
    made, got = answer(chain_model())
    scene = random_cases.step_internals(made, 2, 1)["scene"]
    assert np.all(scene["permit"] == -1.0)
    for name in ("held_error", "n_held", "n_user", "n_obstacles", "any_moving"):
        assert scene[name][0] == 0.0
    assert scene["ready"][0] == 1.0
    assert (got.status, got.h_min, got.n_rows) == (0, 10.0, 0)


@pytest.mark.parametrize(("more", "expected"), [(0.7e-3, VELOCITY), (1.5e-3, ACCELERATION)])
def test_a_bound_is_called_velocity_within_a_thousandth_of_a_step(more, expected):
    """The last control is nearly v_max minus one step, so that both limits nearly coincide."""
    last = 2.0 - 0.01 * (1.0 + more)
    for side in (1.0, -1.0):
        _, got = answer(chain_model(), u_prev=side * last, u_nom=np.full(2, 9.0 * side))
        assert [row[2] for row in got.binding_rows] == [expected, expected]


@pytest.mark.parametrize(("more", "expected"), [(0.7e-3, ACCELERATION), (1.5e-3, AT_LIMIT)])
def test_a_bound_is_called_acceleration_within_a_thousandth_of_a_step(more, expected):
    """The joint limit and the acceleration limit nearly coincide."""
    bound = 0.5 + 0.01 * (1.0 - more)
    for side in (1.0, -1.0):
        q = side * (2.0 - bound / 4.0)  # alpha d is below the braking speed
        _, got = answer(
            chain_model(q_upper=np.full(2, 2.0), a_max=np.full(2, 10.0)),
            q=q,
            u_prev=0.5 * side,
            u_nom=np.full(2, 9.0 * side),
        )
        assert [row[2] for row in got.binding_rows] == [expected, expected]


def position_with_upper_bound(model, bound, u_prev):
    """The position at which the upper control bound of both joints is `bound` (found by bisection)."""
    near, far = 2.0, 0.0
    for _ in range(60):
        q = 0.5 * (near + far)
        made, _ = answer(model, q=q, u_prev=u_prev, u_nom=np.full(2, 9.0))
        near, far = (q, far) if made.box()[1][0] < bound else (near, q)
    return far


@pytest.mark.parametrize(("more", "expected"), [(0.7e-3, JERKED), (1.5e-3, AT_LIMIT)])
def test_a_bound_is_called_jerk_within_a_thousandth_of_a_step(more, expected):
    model = chain_model(j_max=np.full(2, 4000.0))
    step, jerk = 0.01, 4000.0 * 1e-3**2  # change of 4 mrad/s per period
    q = position_with_upper_bound(model, 0.5 + jerk - more * step, 0.5)
    for side in (1.0, -1.0):
        _, got = answer(model, q=side * q, u_prev=0.5 * side, u_nom=np.full(2, 9.0 * side))
        assert [row[2] for row in got.binding_rows] == [expected, expected]


@pytest.mark.parametrize(("lack", "expected"), [(0.8, False), (1.2, True)])
def test_a_joint_limit_is_missed_from_a_fiftieth_of_a_step_on(lack, expected):
    """A violation of the acceleration limit up to 2 % of a step is accepted, on either side and for any joint."""
    slack = 0.02 * 0.01
    for side in (1.0, -1.0):
        for k in range(2):
            q, u = np.zeros(2), np.zeros(2)
            u[k] = side * 0.5
            q[k] = side * (2.0 - (0.5 - 0.01 - lack * slack) / 4.0)
            _, got = answer(chain_model(), q=q, u_prev=u)
            assert bool(got.flags & INFEASIBLE) == expected


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_recovery_asks_for_no_more_than_the_box_allows(side):
    """At rest 5 mm inside an obstacle: 20 mm/s are desired and 5 mm/s are possible, which is not a conflict."""
    _, got = answer(chain_model(), [ball_row((0.7, 0.065 * side, 0.0))], u_nom=np.zeros(2))
    assert (got.status, got.flags, got.relaxed_mask) == (1, 0, 0)
    np.testing.assert_allclose(got.u, -0.01 * side, atol=1e-7)


@pytest.mark.parametrize("outside", [0.0, 0.02, 0.05, 0.1])
def test_outside_its_range_a_joint_returns_at_most_at_four_times_the_recovery_speed(outside):
    """The speed is alpha d if that is slower, plus the tracking error, so that the joint returns in any case."""
    model = chain_model(tracking=np.full(2, 0.01), a_max=np.full(2, 1e4))
    for side in (1.0, -1.0):
        made, got = answer(model, q=side * (2.0 + outside), u_nom=np.full(2, 9.0 * side))
        back = min(4.0 * outside, 4.0 * 0.05) + 0.01
        np.testing.assert_allclose(got.u, -side * back, atol=1e-12)
        np.testing.assert_allclose(made.box()[side > 0.0], -side * back, atol=1e-12)


def test_a_dropped_jerk_limit_is_reported_and_only_then():
    """The jerk limit has priority over the approach speed; it is dropped only if the joint would pass its limit.

    From 0.5 rad/s a stop at 10 rad/s² needs 12.5 mm, and within the jerk limit of 1,000 rad/s³ 15.0 mm.
    """
    model = chain_model(j_max=np.full(2, 1000.0))
    _, got = answer(model, q=0.0, u_prev=0.5, u_nom=np.full(2, 0.5))
    assert not got.flags & JERK
    for side in (1.0, -1.0):
        for distance in (0.497 / 4.0, 0.0155):
            _, got = answer(model, q=side * (2.0 - distance), u_prev=0.5 * side, u_nom=np.full(2, 0.5 * side))
            assert not got.flags & JERK
            np.testing.assert_allclose(got.u, side * (0.5 - 1e-3), atol=1e-9)
        _, got = answer(model, q=side * (2.0 - 0.0145), u_prev=0.5 * side, u_nom=np.full(2, 0.5 * side))
        assert got.flags & JERK
        np.testing.assert_allclose(got.u, side * (0.5 - 0.01), atol=1e-9)


def test_sine_and_cosine_are_exact_to_the_last_place_in_float64():
    """Also for large angles: quarter turns are subtracted in three parts."""
    rng = np.random.default_rng(3)
    for x in (*np.linspace(-7.0, 7.0, 3001), *rng.uniform(-990.0, 990.0, 3000), 999.0, -999.0):
        sine, cosine = _kernel64.sincos(float(x))
        assert abs(sine - math.sin(x)) < 2.3e-16
        assert abs(cosine - math.cos(x)) < 2.3e-16


def test_sine_and_cosine_in_float32_are_unbiased():
    """No term of the series is wrong: near an eighth of a turn, where it matters most, errors average out."""
    for centre in np.arange(-3, 4) * 0.5 * math.pi + 0.25 * math.pi:
        x = np.linspace(centre - 0.06, centre + 0.06, 400).astype(np.float32).astype(float)
        found = np.array([_kernel.sincos(float(value)) for value in x])
        error = found - np.stack([np.sin(x), np.cos(x)], axis=1)
        assert np.max(np.abs(error)) < 8e-8
        assert np.max(np.abs(error.mean(axis=0))) < 1.9e-8


@pytest.mark.parametrize(("n", "kinds"), [(1, (1.0,)), (2, (0.0, 0.0)), (2, (1.0, 1.0)), (2, (1.0, 0.0))])
def test_a_moving_base_has_a_drive_and_a_turn_as_its_first_joints(n, kinds):
    model = chain_model(n, frames=(n,), moving_base=1.0, joint_kind=np.array(kinds))
    if kinds == (1.0, 0.0):
        assert _kernel64.Kernel(model)
    else:
        with pytest.raises(ValueError, match="moving_base"):
            _kernel64.Kernel(model)
