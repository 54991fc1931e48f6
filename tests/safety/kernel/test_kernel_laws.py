"""Laws of parts of the kernel, each with its own oracle: certificate, δ, jerk box, warm start, rejected input."""

import math

import msgspec
import numpy as np
import pytest

from dualbrain.core.geometry.shapes import Box, Capsule, HalfSpace, Pose, Sphere
from dualbrain.errors import GeometryError
from dualbrain.safety.cbf.compiled import _kernel
from dualbrain.safety.cbf.filter import FilterStatus, Obstacle, SafetyFilter
from dualbrain.safety.cbf.result import Reason
from dualbrain.safety.cbf.rows import ConstraintRow
from tests.safety import geometry_oracle, random_scenes

FAR_OUTSIDE = 0.2
"""Excess over a joint range above which the state is rejected [rad]."""
FINITE = Obstacle("x", Capsule(0.05, 0.1), Pose((0.6, 0.3, 0.4)), velocity=(0.0, 0.1, 0.0), static=False)


def test_sine_and_cosine_in_float32_are_within_one_unit_in_the_last_place():
    """Below 1 the unit in the last place is 6e-8; half of it is rounding of the result."""
    for x in np.linspace(-7.0, 7.0, 20001).astype(np.float32):
        sine, cosine = _kernel.sincos(float(x))
        assert abs(sine - math.sin(x)) < 8e-8
        assert abs(cosine - math.cos(x)) < 8e-8


@pytest.mark.parametrize("real", ["float32", "float64"])
def test_certified_means_that_the_next_step_is_safe_or_no_deeper(sparse_panda, state_at, real):
    """At full speed toward obstacles that appear too late, numpy checks the next step of every result, both ways."""
    v = np.array([joint.velocity.value for joint in sparse_panda.joints])
    seen = {True: 0, False: 0}
    for seed in range(70):
        rng = np.random.default_rng(seed)
        q, u_prev = np.array(sparse_panda.home) + rng.uniform(-0.3, 0.3, 7), 0.9 * v * rng.choice([-1.0, 1.0], 7)
        points = geometry_oracle.sphere_centres(sparse_panda, q[None])[0][0]
        way = rng.normal(size=3)
        place = points[rng.integers(6, len(points))] + way / np.linalg.norm(way) * rng.uniform(0.08, 0.16)
        moving = seed % 3 == 0
        velocity = (0.0, 0.0, 0.3) if moving else (0.0, 0.0, 0.0)
        ball = Obstacle("late", Sphere(0.04), Pose(tuple(place.tolist())), velocity=velocity, static=not moving)
        safety = SafetyFilter(sparse_panda, random_scenes.exact_config(precision=real))
        safety.observe([ball], 0.0)
        safety.reset(u_prev)
        answer = safety.filter(state_at(q, opening=0.0), u_prev, 0.0)
        if answer.status is FilterStatus.STOPPED:
            continue
        after = q + sparse_panda.period * answer.u
        shift = np.tile(np.array(velocity) * sparse_panda.period, (1, 1, 1))
        now = np.concatenate([each_gap(sparse_panda, q, ball, np.zeros((1, 1, 3))), self_gaps(sparse_panda, q)])
        then = np.concatenate([each_gap(sparse_panda, after, ball, shift), self_gaps(sparse_panda, after)])
        margin = safety.config.rounding_margin
        kept = np.all((then - margin >= -2e-6) | (then >= now - 2e-6))
        broken = np.any((then - margin < -2e-6) & (then < now - 2e-6))
        if answer.certified:
            assert kept
        else:
            assert answer.status is FilterStatus.FAULT
            assert broken or np.any((then - margin < 2e-6) & (then < now + 2e-6))
        seen[answer.certified] += 1
    assert min(seen.values()) > 3


def each_gap(body, q, obstacle, shift):
    """Gap of every moving sphere to a shifted obstacle."""
    points, radius, names = geometry_oracle.sphere_centres(body, q[None])
    moves = np.array([next(x.frame for x in body.links if x.name == name) > 0 for name in names])
    return (geometry_oracle.surface_distance(obstacle.shape, obstacle.pose, points[0] - shift[0, 0]) - radius)[moves]


def self_gaps(body, q):
    """Gap of every pair of spheres of kept link pairs."""
    points, radius, names = geometry_oracle.sphere_centres(body, q[None])
    names, points = np.array(names), points[0]
    out = []
    for a, b in body.self_pairs.kept:
        i, j = np.flatnonzero(names == a), np.flatnonzero(names == b)
        gaps = np.linalg.norm(points[i][:, None] - points[j], axis=2) - radius[i][:, None] - radius[j]
        out.append(gaps.ravel())
    return np.concatenate(out)


def test_delta_and_its_split_follow_their_equations(sparse_panda, state_at):
    """δ = |u − u_nom|_W ≤ 2: the box part is due to the box around the previous nominal, the row part is the rest."""
    rng = np.random.default_rng(0)
    v = np.array([joint.velocity.value for joint in sparse_panda.joints])
    step = np.array([joint.acceleration.value for joint in sparse_panda.joints]) * sparse_panda.period
    safety = SafetyFilter(sparse_panda, random_scenes.exact_config(precision="float64"))
    safety.observe(random_scenes.random_scene(sparse_panda, rng), 0.0)
    q, last = np.array(sparse_panda.home), np.zeros(7)

    def size(e):
        return math.sqrt(float(np.mean((e / v) ** 2)))

    for k in range(600):
        desired = rng.uniform(-1.3, 1.3, 7) * v if k % 40 == 0 else np.clip(last + rng.uniform(-1, 1, 7) * step, -v, v)
        answer = safety.filter(state_at(q), desired, 0.0)
        followed = np.clip(np.clip(desired, last - step, last + step), -v, v)
        delta, box = min(2.0, size(answer.u - desired)), min(2.0, size(followed - desired))
        assert answer.delta == pytest.approx(delta, abs=1e-9)
        assert answer.delta_box == pytest.approx(min(delta, box), abs=1e-9)
        assert answer.delta_rows == pytest.approx(delta - min(delta, box), abs=1e-9)
        q, last = q + sparse_panda.period * answer.u, desired
    assert safety.filter(state_at(q), 100.0 * v, 0.0).delta == 2.0
    assert safety.filter(state_at(q), np.full(7, np.nan), 0.0).delta == 2.0


LOST_COMMANDS = 3
"""Commands in a row that an arm with jerk limits may miss near its velocity limit (`DBK_LOST_COMMANDS`)."""


def largest_safe_change(u, change, distance, limits, window):
    """The largest change of the control toward a limit after which the hardest stop within the jerk limit is possible.

    By definition: simulate the stop, and search the change by bisection. `limits` are v_max, a dt, j dt² and α. The
    velocity limit is also kept if the change is repeated `LOST_COMMANDS` times, in periods without a command.
    """
    (v, step, jump, alpha), (low, high), dt = limits, window, 1e-3

    def stops(c):
        at, room, fastest = u, distance, u + LOST_COMMANDS * max(c, 0.0)
        for _ in range(100):
            at, fastest, room, most = at + c, fastest + c, room - dt * (at + c), alpha * room
            if fastest > v + 1e-12 or at > most + 1e-12:
                return False
            c = max(c - jump, -step)
        return True

    if stops(high):
        return high
    for _ in range(40):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if stops(middle) else (low, middle)
    return low


@pytest.mark.parametrize("near", [False, True])
def test_the_jerk_box_follows_its_definition(panda, state_at, near):
    """Each bound is the change from which a stop within the jerk limit keeps the velocity limit and the approach."""
    safety = SafetyFilter(panda, random_scenes.exact_config(precision="float64", jerk_limits=True, rounding_margin=0.0))
    names = ("lower", "upper", "velocity", "acceleration", "jerk")
    lower, upper, v, a, j = (np.array([getattr(joint, name).value for joint in panda.joints]) for name in names)
    dt, rng, before, u = panda.period, np.random.default_rng(1), np.zeros(7), np.zeros(7)
    q = upper - 0.2 if near else np.array(panda.home)
    narrowed, desired = 0, v
    for k in range(900):
        desired = v * rng.choice([-1.0, 1.0], 7) if k % 150 == 0 else desired
        answer = safety.filter(state_at(q), desired, 0.0)
        got_low, got_high = (np.array(side) for side in safety._kernel.box())
        for i in range(7):
            jump, change = j[i] * dt * dt, u[i] - before[i]
            limits = (v[i], a[i] * dt, 0.998 * jump, panda.alpha)
            low, high = max(change - jump, -a[i] * dt, -v[i] - u[i]), min(change + jump, a[i] * dt, v[i] - u[i])
            up = largest_safe_change(u[i], change, upper[i] - q[i], limits, (low, high))
            down = largest_safe_change(-u[i], -change, q[i] - lower[i], limits, (-high, -low))
            assert got_high[i] == pytest.approx(u[i] + up, abs=2e-6)
            assert got_low[i] == pytest.approx(u[i] - down, abs=2e-6)
            narrowed += int(up < high - 1e-6)
        assert Reason.JERK not in answer.reason
        before, u = u, answer.u
        q = q + dt * u
    assert narrowed > (100 if near else 3)


def test_a_limit_that_the_acceleration_cannot_keep_is_reported(sparse_panda, state_at):
    """A joint too fast for its limit: the box keeps the acceleration limit, and the result is infeasible."""
    for side, at_limit in ((1.0, "upper"), (-1.0, "lower")):
        q, u_prev = np.array(sparse_panda.home), np.zeros(7)
        q[2], u_prev[2] = side * (abs(getattr(sparse_panda.joints[2], at_limit).value) - 0.01), side * 1.5
        safety = SafetyFilter(sparse_panda, random_scenes.exact_config())
        safety.reset(u_prev)
        answer = safety.filter(state_at(q), u_prev, 0.0)
        assert Reason.INFEASIBLE in answer.reason
        assert abs(answer.u[2]) < 1.5
        safety.reset(-u_prev)  # motion away from the limit is feasible
        assert safety.filter(state_at(q), -u_prev, 0.0).reason == Reason(0)


def test_a_warm_start_changes_the_work_and_not_the_result(sparse_panda, state_at):
    rng = np.random.default_rng(4)
    obstacles = random_scenes.random_scene(sparse_panda, rng, 12)
    warm, cold = (SafetyFilter(sparse_panda, random_scenes.exact_config(precision="float64")) for _ in range(2))
    for safety in (warm, cold):
        safety.observe(obstacles, 0.0)
    v = np.array([joint.velocity.value for joint in sparse_panda.joints])
    q, u, work = np.array(sparse_panda.home), np.zeros(7), np.zeros(2, int)
    for k in range(2500):
        if k % 250 == 0:
            desired = v * rng.choice([-1.0, 1.0], 7)
        one = warm.filter(state_at(q), desired, 0.0)
        cold.reset(u)
        two = cold.filter(state_at(q), desired, 0.0)
        np.testing.assert_allclose(one.u, two.u, atol=1e-8)
        work += (one.iterations, two.iterations)
        q, u = q + sparse_panda.period * one.u, one.u
    assert work[0] < 0.25 * work[1]


NUMBERS = {
    "position": {"pose": Pose((0.6, math.inf, 0.4))},
    "attitude": {"pose": Pose((0.6, 0.3, 0.4), (math.nan, 0.0, 0.0, 0.0))},
    "radius": {"shape": Capsule(math.nan, 0.1)},
    "negative radius": {"shape": Sphere(-0.01)},
    "length": {"shape": Capsule(0.05, math.inf)},
    "extent": {"shape": Box((0.1, math.nan, 0.1))},
    "velocity": {"velocity": (0.0, 0.0, math.nan)},
    "margin": {"margin": math.inf},
    "velocity error": {"velocity_error": math.nan},
    "shrinking": {"velocity_error": -0.1},
    "alpha": {"alpha": -1.0},
}


@pytest.mark.parametrize("change", NUMBERS)
def test_every_number_of_an_obstacle_is_checked(sparse_panda, state_at, change):
    safety = SafetyFilter(sparse_panda, random_scenes.exact_config())
    others = [Obstacle("table", HalfSpace(), Pose((0.0, 0.0, -0.1))), FINITE]
    safety.observe(others, 0.0)
    assert safety.filter(state_at(sparse_panda.home), np.zeros(7), 0.0).status is not FilterStatus.STOPPED
    for place in range(3):
        listed = [*others[:place], msgspec.structs.replace(FINITE, **NUMBERS[change]), *others[place:]]
        with pytest.raises(GeometryError):
            safety.observe(listed, 0.0)
        answer = safety.filter(state_at(sparse_panda.home), np.zeros(7), 0.0)
        assert answer.status is FilterStatus.STOPPED
        assert answer.reason == Reason.BAD_SCENE


@pytest.mark.parametrize("column", range(4))
def test_every_number_of_a_held_object_and_of_a_row_is_checked(sparse_panda, state_at, column):
    safety = SafetyFilter(sparse_panda, random_scenes.exact_config())
    held = np.array([[0.0, 0.0, 0.05, 0.02], [0.0, 0.0, 0.07, 0.02]])
    held[1, column] = math.nan if column == 3 else 0.01
    with pytest.raises(GeometryError):
        safety.attach(held, 0.0 if column == 3 else math.nan)
    assert Reason.BAD_SCENE in safety.filter(state_at(sparse_panda.home), np.zeros(7), 0.0).reason
    safety.detach()
    assert safety.filter(state_at(sparse_panda.home), np.zeros(7), 0.0).status is FilterStatus.SAFE
    a = [1.0] * 7
    a[column] = math.inf
    rows = [
        ConstraintRow(name="good", a=(1.0,) * 7, b=-9.0),
        ConstraintRow(name="bad", a=tuple(a) if column else (1.0,) * 7, b=math.nan if not column else -1.0),
    ]
    with pytest.raises(GeometryError):
        safety.constrain(rows)
    assert Reason.BAD_SCENE in safety.filter(state_at(sparse_panda.home), np.zeros(7), 0.0).reason
    safety.constrain([])
    assert safety.filter(state_at(sparse_panda.home), np.zeros(7), 0.0).status is FilterStatus.SAFE


def test_ages_are_accepted_up_to_their_limits_with_a_small_skew(sparse_panda, state_at):
    safety = SafetyFilter(sparse_panda, random_scenes.exact_config())
    safety.observe([FINITE], 10.0)
    most = safety.config.state_stale_after, safety.config.scene_stale_after
    for state_age, scene_age, expected in (
        (0.98 * most[0], 0.98 * most[1], Reason(0)),
        (-0.0049, -0.0049, Reason(0)),
        (1.02 * most[0], 0.0, Reason.STALE_STATE),
        (-0.0051, 0.0, Reason.STALE_STATE),
        (0.0, 1.02 * most[1], Reason.STALE_SCENE),
        (0.0, -0.0051, Reason.STALE_SCENE),
    ):
        now = 10.0 + scene_age
        answer = safety.filter(state_at(sparse_panda.home, t=now - state_age), np.zeros(7), now)
        assert answer.reason & (Reason.STALE_STATE | Reason.STALE_SCENE) == expected


def test_a_joint_is_accepted_up_to_a_fifth_of_a_radian_beyond_its_limits(sparse_panda, state_at):
    for k, joint in enumerate(sparse_panda.joints):
        for limit, side in ((joint.upper.value, 1.0), (joint.lower.value, -1.0)):
            for beyond, stops in ((0.19, False), (0.21, True)):
                q = np.array(sparse_panda.home)
                q[k] = limit + side * beyond
                answer = SafetyFilter(sparse_panda, random_scenes.exact_config()).filter(state_at(q), np.zeros(7), 0.0)
                assert (Reason.OUTSIDE_LIMITS in answer.reason) == stops


def test_braking_slows_every_joint_by_the_same_factor(sparse_panda, state_at):
    """The hardest braking along the path: one joint at its full deceleration, all joints stop together."""
    rng = np.random.default_rng(2)
    step = np.array([joint.acceleration.value for joint in sparse_panda.joints]) * sparse_panda.period
    for _ in range(50):
        u_prev = rng.uniform(-2.0, 2.0, 7) * rng.choice([1.0, 0.003])
        safety = SafetyFilter(sparse_panda, random_scenes.exact_config(precision="float64"))
        safety.reset(u_prev)
        u = safety.filter(state_at(sparse_panda.home), np.full(7, np.nan), 0.0).u
        keep = max(0.0, *(1.0 - step / np.maximum(np.abs(u_prev), step)))
        np.testing.assert_allclose(u, keep * u_prev, atol=1e-12)


@pytest.mark.parametrize("seed", range(12))
def test_a_moving_arm_is_filtered_at_its_lag_compensated_posture(sparse_panda, state_at, seed):
    """Rows are evaluated at y = q + lag v: the result is that of an arm at rest in y."""
    rng = np.random.default_rng(seed)
    safety = SafetyFilter(sparse_panda, random_scenes.exact_config(precision="float64", lag_compensation=True))
    safety.observe(random_scenes.random_scene(sparse_panda, rng, 10), 0.0)
    q, v = np.array(sparse_panda.home) + rng.uniform(-0.2, 0.2, 7), rng.uniform(-1.0, 1.0, 7)
    desired, u_prev = rng.uniform(-2.0, 2.0, 7), rng.uniform(-0.3, 0.3, 7)
    answers = []
    for where, speed in ((q, v), (q + sparse_panda.tracking.lag * v, np.zeros(7)), (q, np.zeros(7))):
        safety.reset(u_prev)
        answers.append(safety.filter(state_at(where, speed), desired, 0.0))
    moving, there, here = answers
    assert sparse_panda.tracking.lag > 0.0
    assert moving.h_min == pytest.approx(there.h_min, abs=1e-9)
    assert moving.u == pytest.approx(there.u, abs=1e-6)
    assert abs(moving.h_min - here.h_min) > 1e-7, "the lag has an effect here"


def test_the_parts_of_the_intervention_add_up_also_for_invalid_nominals(sparse_panda, state_at):
    safety = SafetyFilter(sparse_panda, random_scenes.exact_config())
    for desired in (np.full(7, np.nan), np.full(7, 1.0), np.zeros(7)):
        answer = safety.filter(state_at(np.array(sparse_panda.home)), desired, 0.0)
        assert answer.delta_rows + answer.delta_box == pytest.approx(answer.delta, abs=1e-6)
        assert answer.delta_rows >= 0.0
        assert answer.delta_box >= 0.0


@pytest.mark.parametrize("joint", range(7))
def test_an_arm_is_far_outside_by_its_lag_compensated_posture(sparse_panda, state_at, joint):
    """The excess over the range is evaluated at y = q + lag v."""
    safety = SafetyFilter(sparse_panda, random_scenes.exact_config(precision="float64", lag_compensation=True))
    lag, limit = sparse_panda.tracking.lag, sparse_panda.joints[joint].upper.value + FAR_OUTSIDE
    for beyond in (-0.1, 0.1):
        q, v = np.array(sparse_panda.home), np.zeros(7)
        v[joint] = 1.0
        q[joint] = limit - lag * (1.0 - beyond)
        answer = safety.filter(state_at(q, v), np.zeros(7), 0.0)
        assert (Reason.OUTSIDE_LIMITS in answer.reason) == (beyond > 0.0)
