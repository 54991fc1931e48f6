"""Jerk box: the change of the acceleration stays within its limit, and the other guarantees hold."""

import msgspec
import numpy as np
import pytest

from dualbrain.core.geometry.shapes import Sphere
from dualbrain.errors import ConfigurationError
from dualbrain.records import Pose
from dualbrain.robots.loader import load_robot
from dualbrain.safety.cbf.filter import FilterStatus, Obstacle, SafetyFilter
from dualbrain.safety.cbf.result import Reason
from tests.safety import geometry_oracle, random_scenes


def test_a_robot_model_without_jerk_limits_is_rejected(sparse_panda):
    bare = tuple(msgspec.structs.replace(joint, jerk=None) for joint in sparse_panda.joints)
    with pytest.raises(ConfigurationError, match="jerk"):
        SafetyFilter(msgspec.structs.replace(sparse_panda, joints=bare), random_scenes.exact_config(jerk_limits=True))


@pytest.mark.parametrize("seed", range(3))
def test_jerk_stays_in_its_limit_under_an_adversary(sparse_panda, seed):
    rng = np.random.default_rng(seed)
    obstacles = random_scenes.random_scene(sparse_panda, rng, 8)
    safety = SafetyFilter(sparse_panda, random_scenes.exact_config(jerk_limits=True))
    safety.observe(obstacles)
    v_max = np.array([joint.velocity.value for joint in sparse_panda.joints])
    limit = np.array([joint.jerk.value for joint in sparse_panda.joints]) * sparse_panda.period**2
    q, log, yielded, u, before = np.array(sparse_panda.home), [], 0, np.zeros(7), np.zeros(7)
    for tick in range(4000):
        if tick % 250 == 0:
            desired = np.where(rng.random(7) < 0.5, -1.0, 1.0) * v_max
        answer = safety(q, np.zeros(7), desired, opening=0.0)
        jerk = np.abs(answer.u - 2.0 * u + before)
        if Reason.JERK in answer.reason:
            yielded += 1
        elif answer.status is not FilterStatus.RELAXED:
            assert np.all(jerk <= limit * (1 + 1e-3) + 2e-6)
        u, before = answer.u, u
        q = q + sparse_panda.period * u
        log.append(q)
    assert yielded < 40
    log = np.array(log)
    assert (
        min(
            geometry_oracle.h_obstacles(sparse_panda, log, obstacles).min(),
            geometry_oracle.h_self(sparse_panda, log).min(),
        )
        >= 0.0
    )
    assert geometry_oracle.h_joints(sparse_panda, log).min() >= 0.0


LOST_COMMANDS = 3
"""Periods for which the acceleration may continue near the velocity limit (`DBK_LOST_COMMANDS`)."""


def test_without_the_box_jerk_is_larger(sparse_panda):
    safety = SafetyFilter(sparse_panda, random_scenes.exact_config())
    limit = np.array([joint.jerk.value for joint in sparse_panda.joints]) * sparse_panda.period**2
    first = safety(np.array(sparse_panda.home), np.zeros(7), np.full(7, 2.0)).u
    assert np.any(np.abs(first) > 1.5 * limit)


def test_the_binding_limit_is_named(sparse_panda):
    """Full speed from rest, then back: jerk, acceleration and velocity limits bind in turn, each by its formula."""
    safety = SafetyFilter(sparse_panda, random_scenes.exact_config(jerk_limits=True, precision="float64"))
    first = sparse_panda.joints[0]
    dt, v_max, a_max, j_max = sparse_panda.period, first.velocity.value, first.acceleration.value, first.jerk.value
    seen, u, before = [], 0.0, 0.0
    for tick in range(2000):
        direction = 1.0 if tick < 60 else -1.0  # reversed while it still accelerates
        answer = safety(np.array(sparse_panda.home), np.zeros(7), np.array([9.0 * direction, 0, 0, 0, 0, 0, 0]))
        bounds = {
            "velocity": direction * v_max,
            "acceleration": u + direction * a_max * dt,
            "jerk": 2.0 * u - before + direction * j_max * dt**2,
        }
        for name in (name for name, _, _ in answer.active_rows if name.startswith(first.name + " ")):
            kind = name.split()[1]
            change, left = direction * (float(answer.u[0]) - u), v_max - direction * float(answer.u[0])
            if kind == "velocity" and left > 1e-3 * a_max * dt:  # the end of the acceleration before the velocity limit
                steps = np.arange(1.0, 30.0)
                rest = LOST_COMMANDS * change + np.maximum(change - steps * j_max * dt**2, 0.0).sum()
                assert left == pytest.approx(rest, abs=0.01 * j_max * dt**2)
                continue
            assert answer.u[0] == pytest.approx(bounds[kind], abs=1e-3 * a_max * dt), kind
            seen.append((kind, direction))
        before, u = u, float(answer.u[0])
    assert {kind for kind, _ in seen} == {"velocity", "acceleration", "jerk"}
    assert seen.count(("jerk", -1.0)) > 1, "also while the acceleration changes"


# --- approaches to the joint limits -------------------------------------------------------------------------------


def scaled_robot(robot_model, jerk, period):
    """`robot_model` without collision spheres, with jerk limits scaled by `jerk`, at another control period."""
    joints = tuple(
        msgspec.structs.replace(one, jerk=msgspec.structs.replace(one.jerk, value=jerk * one.jerk.value))
        for one in robot_model.joints
    )
    pairs = msgspec.structs.replace(robot_model.self_pairs, kept=())
    return msgspec.structs.replace(robot_model, joints=joints, spheres=(), self_pairs=pairs, period=period)


def limits_of(robot_model):
    """Lower, upper, velocity, acceleration and jerk limits of all joints, each (n,)."""
    names = ("lower", "upper", "velocity", "acceleration", "jerk")
    return [np.array([getattr(joint, name).value for joint in robot_model.joints]) for name in names]


@pytest.mark.parametrize("name", ["fr3", "panda"])
@pytest.mark.parametrize(
    ("jerk", "period", "alpha_joint"),
    [(1.0, 1e-3, None), (0.1, 1e-3, None), (0.01, 1e-3, None), (1.0, 4e-3, None), (0.05, 5e-3, None), (1.0, 1e-3, 6.0)],
)
@pytest.mark.parametrize("precision", ["float32", "float64"])
def test_full_speed_into_every_joint_limit_keeps_all_limits(name, jerk, period, alpha_joint, precision):
    """From random states every joint is driven into its limits at full speed; no limit of any order is exceeded.

    The reversals come at random times, also while a joint still accelerates. In float32 the limits hold up to the
    rounding of the control.
    """
    robot = scaled_robot(load_robot(name), jerk, period)
    lower, upper, v_max, a_max, j_max = limits_of(robot)
    safety = SafetyFilter(
        robot, random_scenes.exact_config(jerk_limits=True, precision=precision, alpha_joint=alpha_joint)
    )
    rng, room = np.random.default_rng(0), 1.0 + (1e-9 if precision == "float64" else 2e-5)
    touched = np.zeros((2, robot.n), bool)
    for trial in range(2):
        q, u, before = rng.uniform(lower + 0.05, upper - 0.05), np.zeros(robot.n), np.zeros(robot.n)
        safety.reset()
        reversal, direction = int(4.0 / period), (-1.0) ** trial * np.ones(robot.n)
        for tick in range(int(7.0 / period)):
            if tick == reversal:
                direction = -direction * rng.choice([1.0, 1.0, 1.0, -1.0], robot.n)
                reversal += int(rng.choice([0.02, 0.15, 1.5]) / period)
            answer = safety(q, np.zeros(robot.n), 1.2 * direction * v_max)
            assert Reason.JERK not in answer.reason
            assert answer.status in (FilterStatus.SAFE, FilterStatus.MODIFIED)
            change, last_change = answer.u - u, u - before
            assert np.all(np.abs(answer.u) <= v_max * room)
            assert np.all(np.abs(change) <= a_max * period * room)
            assert np.all(np.abs(change - last_change) <= j_max * period**2 * room)
            before, u = u, answer.u
            q = q + period * u
            assert np.all((q <= upper) & (q >= lower))
            touched |= np.array([q < lower + 0.02, q > upper - 0.02])
    assert touched.all(), "every end of every joint was reached"


def test_a_start_at_speed_before_a_limit_keeps_all_limits_if_a_stop_is_possible():
    """Starts at random speed, with a distance from which the joint can just stop within acceleration and jerk."""
    robot = scaled_robot(load_robot("fr3"), 0.2, 1e-3)
    lower, upper, v_max, a_max, j_max = limits_of(robot)
    safety = SafetyFilter(robot, random_scenes.exact_config(jerk_limits=True))
    rng = np.random.default_rng(1)
    for _ in range(40):
        side, u = rng.choice([-1.0, 1.0], robot.n), rng.uniform(0.05, 1.0, robot.n) * v_max
        stop = 0.5 * u**2 / a_max + 0.5 * u * a_max / j_max + 2e-3 * u + 2e-3
        u, q = side * u, np.where(side > 0.0, upper - stop, lower + stop)
        before = u
        safety.reset(u)
        for _ in range(900):
            answer = safety(q, np.zeros(robot.n), side * v_max)
            assert Reason.JERK not in answer.reason
            assert np.all(np.abs(answer.u - 2.0 * u + before) <= j_max * 1e-6 * (1.0 + 1e-3))
            assert np.all(np.abs(answer.u - u) <= a_max * 1e-3 * (1.0 + 1e-4))
            before, u = u, answer.u
            q = q + 1e-3 * u
            assert np.all((q <= upper) & (q >= lower))


@pytest.mark.parametrize("status", [FilterStatus.STOPPED, FilterStatus.FAULT, FilterStatus.RELAXED])
def test_braking_keeps_the_jerk_limit_until_rest(sparse_panda, status):
    """A rejected input, a conflict and a state that cannot be certified brake within the jerk limit."""
    _, _, v_max, _, j_max = limits_of(sparse_panda)
    safety = SafetyFilter(sparse_panda, random_scenes.exact_config(jerk_limits=True))
    q, u, before = np.array(sparse_panda.home), np.zeros(7), np.zeros(7)
    for tick in range(900):
        bad = tick >= 100
        if bad and status is FilterStatus.STOPPED:
            answer = safety(q * np.nan, np.zeros(7), 0.5 * v_max)
        else:
            if tick == 100:
                place = safety.tool(q).position + (0.0 if status is FilterStatus.FAULT else 0.09)
                ball = Obstacle("ball", Sphere(0.08), Pose(tuple(place)), velocity=(-0.6, -0.6, -0.6), static=False)
                safety.observe([ball])
            answer = safety(q, np.zeros(7), np.zeros(7) if bad else 0.5 * v_max)
        assert np.all(np.abs(answer.u - 2.0 * u + before) <= j_max * 1e-6 * (1.0 + 1e-3)), tick
        before, u = u, answer.u
        q = q + 1e-3 * u
        if bad and status is FilterStatus.STOPPED:
            assert answer.status is status
    if status is FilterStatus.STOPPED:
        assert np.all(np.abs(u) < 1e-6)


@pytest.mark.parametrize("wish", [-1.0, 1.0])
def test_the_first_control_after_a_reset_continues_its_change(sparse_panda, wish):
    """The jerk limits hold around u_prev + u_change, the control that would continue at constant acceleration."""
    safety = SafetyFilter(sparse_panda, random_scenes.exact_config(jerk_limits=True))
    acceleration = np.array([joint.acceleration.value for joint in sparse_panda.joints]) * sparse_panda.period
    limit = np.array([joint.jerk.value for joint in sparse_panda.joints]) * sparse_panda.period**2
    u_prev, u_change = np.full(7, 0.1), 0.5 * acceleration
    safety.reset(u_prev, u_change)
    u = safety(np.array(sparse_panda.home), np.zeros(7), np.full(7, wish)).u
    np.testing.assert_allclose(np.abs(u - u_prev - u_change), np.minimum(limit, 1.5 * acceleration), rtol=1e-3)
