"""The Cartesian speed limit holds for every returned control, by an oracle that shares nothing with the kernel."""

import msgspec
import numpy as np
import pytest
from scipy.optimize import minimize

from dualbrain.core.geometry.shapes import Capsule, Pose
from dualbrain.errors import GeometryError
from dualbrain.robots.interface import RobotState
from dualbrain.robots.loader import load_robot
from dualbrain.robots.model import CollisionSphere
from dualbrain.robots.site_config import read_site
from dualbrain.runtime.assembly import SimulatedCell
from dualbrain.safety.cbf.config import operating_config
from dualbrain.safety.cbf.filter import FilterConfig, FilterStatus, Obstacle, Rank, SafetyFilter
from dualbrain.safety.cbf.result import SPEED
from dualbrain.safety.integration.site import site_filter
from dualbrain.safety.stop_cause import Reason
from tests.safety.kernel.cartesian_speed.closed_loop import run_loop
from tests.safety.kernel.cartesian_speed.speed_oracle import SpeedOracle
from tests.safety.kernel.test_kinematics import moved_centres

CASES = {
    "panda": ("panda", 0.4, {}),
    "slow": ("panda", 0.05, {}),
    "float64": ("panda", 0.25, {"precision": "float64"}),
    "held": ("panda", 0.25, {"held": True}),
    "jerk": ("panda", 0.25, {"jerk_limits": True}),
    "person": ("panda", 0.25, {"person": True}),
    "ur5e": ("ur5e", 0.4, {}),
    "ur5e person": ("ur5e", 0.2, {"person": True, "held": True}),
}


@pytest.mark.parametrize("name", CASES)
def test_no_step_is_above_the_limit(name):
    robot, limit, options = CASES[name]
    report = run_loop(robot, limit, 1500, 7, **options)
    assert report.above == 0, f"{report.worst:.6f} m/s"
    assert report.binding > 500
    assert report.worst > 0.97 * limit, "the limit is used"
    assert report.overspeed == 0
    assert report.acceleration < 1.0 + 1e-4
    if options.get("jerk_limits"):
        assert report.jerk < 1.0 + 1e-3
    if options.get("person"):
        assert report.statuses.get("RELAXED", 0) > 0, "the person reached the robot"


@pytest.mark.parametrize("robot", ["panda", "ur5e"])
def test_without_the_limit_the_same_nominal_control_exceeds_it(robot):
    report = run_loop(robot, 0.4, 1500, 7, limited=False)
    assert report.above > 500
    assert report.worst > 2.0 * 0.4


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_no_step_of_many_is_above_the_limit(name):
    robot, limit, options = CASES[name]
    for seed in range(5):
        assert run_loop(robot, limit, 20000, seed, **options).above == 0


def random_arm(rng):
    """The Panda with random joint offsets, spheres and limits, without self-collision pairs."""
    base = load_robot("panda")
    joints = tuple(
        msgspec.structs.replace(joint, translation=tuple(rng.uniform(-0.3, 0.3, 3).tolist())) for joint in base.joints
    )
    spheres = tuple(
        CollisionSphere(sphere.link, tuple(rng.uniform(-0.15, 0.15, 3).tolist()), sphere.radius)
        for sphere in base.spheres
    )
    pairs = msgspec.structs.replace(base.self_pairs, kept=())
    return msgspec.structs.replace(base, joints=joints, spheres=spheres, self_pairs=pairs)


@pytest.mark.parametrize("precision", ["float32", "float64"])
def test_random_robots_and_controls(precision):
    """Independent states without acceleration limits: braking to rest in one step is admissible, so all must hold."""
    rng = np.random.default_rng(3)
    for _ in range(12):
        model, limit = random_arm(rng), float(rng.choice([0.02, 0.1, 0.3, 1.0]))
        config = FilterConfig(
            cartesian_speed=limit,
            lag_compensation=False,
            tracking_error=0.0,
            acceleration_limits=False,
            precision=precision,
        )
        safety, oracle = SafetyFilter(model, config), SpeedOracle(model)
        lower = np.array([joint.lower.value for joint in model.joints])
        upper = np.array([joint.upper.value for joint in model.joints])
        for _ in range(25):
            q, u = rng.uniform(lower, upper), rng.uniform(-2.5, 2.5, model.n) * rng.choice([0.1, 1.0, 10.0])
            safety.reset(rng.uniform(-1.0, 1.0, model.n))
            result = safety(q, np.zeros(model.n), u, opening=0.0)
            assert oracle.speeds(q, result.u).max() <= limit
            assert not result.flags & Reason.OVERSPEED


def closest_in_cones(weight, jacobians, limit, v_max, u_nom):
    """The control closest to u_nom with |J_p u| ≤ limit for all p and |u| ≤ v_max, by a general NLP solver."""
    start = np.zeros(len(u_nom))

    def room(u):
        return limit**2 - np.sum((jacobians @ u) ** 2, axis=1)

    def room_gradient(u):
        return -2.0 * np.einsum("pe,pen->pn", jacobians @ u, jacobians)

    found = minimize(
        lambda u: 0.5 * float((u - u_nom) @ weight @ (u - u_nom)),
        start,
        jac=lambda u: weight @ (u - u_nom),
        bounds=list(zip(-v_max, v_max, strict=True)),
        constraints=[{"type": "ineq", "fun": room, "jac": room_gradient}],
        method="SLSQP",
        options={"maxiter": 400, "ftol": 1e-14},
    )
    assert room(found.x).min() > -1e-7
    return found.fun


@pytest.mark.parametrize("limit", [0.1, 0.4])
def test_the_control_is_the_closest_one_in_the_cones(limit):
    """The cost is between those of an independent cone program with the limit and with 0.2 % less."""
    model, rng = load_robot("panda"), np.random.default_rng(5)
    model = msgspec.structs.replace(
        model, spheres=model.spheres[::6], self_pairs=msgspec.structs.replace(model.self_pairs, kept=())
    )
    config = FilterConfig(
        cartesian_speed=limit,
        lag_compensation=False,
        tracking_error=0.0,
        acceleration_limits=False,
        precision="float64",
        alpha_joint=1e3,
    )
    safety, oracle = SafetyFilter(model, config), SpeedOracle(model)
    v_max = np.array([joint.velocity.value for joint in model.joints])
    weight = np.diag(1.0 / v_max**2)
    for _ in range(8):
        q = np.array(model.home) + rng.uniform(-0.3, 0.3, model.n)
        u_nom = v_max * rng.uniform(-1.0, 1.0, model.n)
        safety.reset(0.0)
        result = safety(q, np.zeros(model.n), u_nom, opening=0.0)
        cost = 0.5 * float((result.u - u_nom) @ weight @ (result.u - u_nom))
        jacobians = oracle.jacobian(q)
        assert result.status is FilterStatus.MODIFIED
        assert oracle.speeds(q, result.u).max() <= limit
        least = closest_in_cones(weight, jacobians, limit, v_max, u_nom)
        most = closest_in_cones(weight, jacobians, 0.998 * limit, v_max, u_nom)
        assert least - 1e-9 <= cost <= most + 1e-6


def test_the_projection_keeps_the_limit_and_the_filter_passes_it_unchanged():
    model, rng = load_robot("panda"), np.random.default_rng(11)
    safety = SafetyFilter(model, FilterConfig(cartesian_speed=0.25, lag_compensation=False, tracking_error=0.0))
    oracle, q, u, same = SpeedOracle(model), np.array(model.home), np.zeros(model.n), 0
    for k in range(600):
        if k % 150 == 0:
            wanted = rng.uniform(-2.0, 2.0, model.n)
        state = RobotState(stamp=0.0, sequence=k, q=q, v=u, opening=0.0, finger_forces=(0.0, 0.0))
        nominal = safety.project(state, wanted, u, 0.0)
        result = safety.filter(state, nominal, 0.0)
        assert oracle.speeds(q, result.u).max() <= 0.25
        same += bool(np.array_equal(result.u, nominal))
        u = result.u
        q = q + model.period * u
    assert same > 590


def test_the_speed_limit_has_priority_over_a_person_who_comes_nearer():
    """The robot evades at the limit, not faster; without the limit it evades faster."""

    def evade(limit):
        model = load_robot("panda")
        config = FilterConfig(cartesian_speed=limit, lag_compensation=False, tracking_error=0.0)
        safety, oracle = SafetyFilter(model, config), SpeedOracle(model)
        q, u, fastest, relaxed = np.array(model.home), np.zeros(model.n), 0.0, 0
        start = safety.tool(q).position + np.array([0.45, 0.0, 0.0])
        for k in range(700):
            person = Obstacle(
                name="person",
                shape=Capsule(0.1, 0.4),
                pose=Pose(tuple((start - np.array([0.9e-3 * k, 0.0, 0.0])).tolist())),
                velocity=(-0.9, 0.0, 0.0),
                static=False,
                rank=Rank.BODY,
            )
            safety.observe([person], k * 1e-3)
            result = safety(q, u, np.zeros(model.n), k * 1e-3, 0.0)
            fastest, relaxed = max(fastest, oracle.speeds(q, result.u).max()), relaxed + bool(result.relaxed_mask)
            u = result.u
            q = q + 1e-3 * u
        return fastest, relaxed

    fastest, relaxed = evade(0.2)
    assert 0.18 < fastest <= 0.2
    assert relaxed > 0
    assert evade(None)[0] > 0.4


def test_a_state_that_is_too_fast_is_braked_and_reported():
    model = load_robot("panda")
    safety = SafetyFilter(model, FilterConfig(cartesian_speed=0.1, lag_compensation=False, tracking_error=0.0))
    oracle, q = SpeedOracle(model), np.array(model.home)
    u = np.array([1.0, 0.5, 0.0, 0.5, 0.0, 0.0, 0.0])
    safety.reset(u)
    before, reported = oracle.speeds(q, u).max(), 0
    for _ in range(200):
        result = safety(q, u, u, 0.0, 0.0)
        now = oracle.speeds(q, result.u).max()
        assert now <= max(before + 1e-3, 0.1)
        reported += bool(result.flags & Reason.OVERSPEED)
        assert ("keeps the speed limits" in result.explain()) == bool(result.flags & Reason.OVERSPEED)
        u, before = result.u, now
        q = q + model.period * u
    assert before <= 0.1
    assert 10 < reported < 150


def test_the_result_names_the_limit():
    model = load_robot("panda")
    safety = SafetyFilter(model, FilterConfig(cartesian_speed=0.1))
    q, v = np.array(model.home), np.zeros(model.n)
    for _ in range(100):
        result = safety(q, v, np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]), 0.0, 0.0)
    assert any(row[0] == SPEED for row in result.binding_rows)
    assert result.barriers == ("cartesian_speed",)
    assert result.limiting_row.endswith("speed limit")
    assert "speed limit" in result.explain()
    assert any(row.name.endswith("speed limit") for row in safety.rows())


@pytest.mark.parametrize("value", [0.0, -1.0, float("nan"), 1e9, "fast", True, 1e-5])
def test_a_limit_that_cannot_be_used_is_refused(value):
    with pytest.raises(GeometryError, match="cartesian_speed"):
        FilterConfig(cartesian_speed=value)


def test_a_robot_is_operated_with_its_tool_speed():
    assert operating_config(load_robot("panda")).cartesian_speed == load_robot("panda").tool_speed.value
    assert operating_config(load_robot("mobile_panda")).cartesian_speed == load_robot("mobile_panda").tool_speed.value
    assert operating_config(load_robot("base")).cartesian_speed is None


def test_a_simulated_cell_and_a_site_filter_keep_the_tool_speed(tmp_path):
    assert SimulatedCell.make("panda").safety.config.cartesian_speed == load_robot("panda").tool_speed.value
    path = tmp_path / "lab.toml"
    path.write_text("[robot]\ntool_speed = 0.15\n")
    assert site_filter(read_site(path), load_robot("panda")).config.cartesian_speed == 0.15


def test_the_limit_of_a_mobile_manipulator_is_relative_to_the_mount_of_its_arm():
    model = load_robot("mobile_panda")
    safety = SafetyFilter(model, FilterConfig(cartesian_speed=0.1, tracking_error=0.0))
    q, u = np.concatenate([np.zeros(3), model.home[-7:]]), np.zeros(model.n)
    wanted = np.concatenate([[model.joints[0].velocity.value, 0.0], np.ones(7)])
    for k in range(600):
        result = safety(q, u, wanted, 0.0, 0.0)
        u = result.u
        q = q + model.period * np.concatenate([[u[0], 0.0, 0.0], u[2:]])
        near, far = (
            safety.tool(np.concatenate([np.zeros(3), q[3:] + side * 1e-4 * u[2:]])).position for side in (-1, 1)
        )
        assert np.linalg.norm(far - near) / 2e-4 <= 0.1 * 1.02, k
    assert u[0] > 0.9 * model.joints[0].velocity.value


@pytest.mark.parametrize("direction", [(0.2, 1.0), (0.3, -0.8), (0.4, 0.5)])
def test_a_base_on_an_arc_needs_no_reserve_as_no_point_becomes_faster(direction):
    """The velocity along the drive axis turns with the base: the speeds of all points are constant."""
    body, limit, u = load_robot("base"), 0.4, np.array(direction)
    safety = SafetyFilter(body, FilterConfig(cartesian_speed=limit, lag_compensation=False, tracking_error=0.0))
    q = np.zeros(3)
    x, y, _ = moved_centres(body, q).T
    u *= 0.9985 * limit / np.hypot(u[0] - u[1] * y, u[1] * x).max()
    safety.reset(u)
    assert safety(q, u, u, 0.0, 0.0).status is FilterStatus.SAFE
