"""A mobile manipulator is one chain; its tool, Jacobian and barrier rows agree with independent computations."""

import msgspec
import mujoco
import numpy as np
import pytest

from dualbrain.core.geometry.shapes import Pose, Sphere
from dualbrain.errors import ConfigurationError
from dualbrain.robots.builtin.mobile_panda import ARM_MOUNT_POSITION, HOUSING_BOX, PEDESTAL_BOX
from dualbrain.robots.differential_drive import integrate_configuration
from dualbrain.robots.loader import load_robot
from dualbrain.robots.mobile_manipulator import extract_arm, extract_base, mount_arm_on_base
from dualbrain.safety.barriers.keep_out import scenario_base
from dualbrain.safety.barriers.scenarios import EXACT_TRACKING
from dualbrain.safety.cbf.compiled import _kernel_wide
from dualbrain.safety.cbf.filter import FilterConfig, Obstacle, SafetyFilter
from dualbrain.simulation.identification.mobile_tracking_model import DRIVE_REGION
from dualbrain.simulation.plant.mobile_manipulator_plant import MobileManipulatorPlant
from dualbrain.simulation.scenes.scene_spec import SceneSpec

BODY, PANDA = load_robot("mobile_panda"), load_robot("panda")
LOW = np.array([joint.lower.value for joint in BODY.joints[2:]])
HIGH = np.array([joint.upper.value for joint in BODY.joints[2:]])


def configuration(rng):
    return np.array([*rng.uniform(-3.0, 3.0, 3), *rng.uniform(LOW, HIGH)])


def test_the_model_combines_arm_and_base():
    assert BODY.n == 9
    assert BODY.nq == 10
    assert BODY.is_mobile_manipulator
    assert BODY.alpha == PANDA.alpha
    assert BODY.joints[3:] == PANDA.joints[1:]
    assert set(PANDA.self_pairs.kept) < set(BODY.self_pairs.kept)
    assert ("base", "hand") in BODY.self_pairs.kept
    assert isinstance(SafetyFilter(BODY)._kernel, _kernel_wide.Kernel)
    assert not any(link.frame == 0 for link in BODY.links), "no link of a mobile robot is fixed to the world"


def test_arm_and_base_can_be_extracted():
    arm, base = extract_arm(BODY), extract_base(BODY)
    assert [link.frame for link in arm.links] == [link.frame for link in PANDA.links]
    assert arm.spheres == PANDA.spheres
    assert arm.self_pairs.kept == PANDA.self_pairs.kept
    assert (base.n, base.nq, base.is_mobile, base.is_mobile_manipulator) == (2, 3, True, False)
    with pytest.raises(ConfigurationError, match="is not a mobile manipulator"):
        mount_arm_on_base(
            "x",
            BODY,
            PANDA,
            ARM_MOUNT_POSITION,
            home=(),
            tracking=PANDA.tracking,
            base_lag=None,
            n_samples=1,
            rng=np.random.default_rng(0),
        )


@pytest.mark.parametrize(("middle", "half"), [HOUSING_BOX, PEDESTAL_BOX])
def test_the_spheres_cover_housing_and_pedestal(middle, half):
    rng = np.random.default_rng(0)
    points = np.array(middle) + np.array(half) * rng.uniform(-1.0, 1.0, (4000, 3))
    inside = np.zeros(len(points), bool)
    for sphere in extract_base(BODY).spheres:
        inside |= np.linalg.norm(points - sphere.centre, axis=1) <= sphere.radius
    assert inside.all()


def test_tool_and_jacobian_are_those_of_mujoco():
    """The model of the plant is independent of the robot model: its joints are x, y, yaw and those of the arm."""
    plant = MobileManipulatorPlant(
        SceneSpec(robot="mobile_panda", family="hall", seed=0, objects=(), places=(), mover=None, region=DRIVE_REGION),
        BODY,
    )
    safety, rng = SafetyFilter(BODY, FilterConfig(precision="float64")), np.random.default_rng(3)
    tool = int(plant.model.site("robot/tcp").id)
    for _ in range(30):
        q = configuration(rng)
        plant.set_configuration(q)
        J = np.zeros((6, plant.model.nv))
        mujoco.mj_jacSite(plant.model, plant.data, J[:3], J[3:], tool)
        x, y, yaw = (J[:, plant.model.joint(f"robot/{name}").dofadr[0]] for name in ("x", "y", "yaw"))
        _, arm = plant.arm_slices
        tool_frame = safety.tool(q)
        expected = np.column_stack([x * np.cos(q[2]) + y * np.sin(q[2]), yaw, J[:, arm]])
        position, rotation = plant.tool_pose()
        np.testing.assert_allclose(tool_frame.position, position, atol=1e-9)
        np.testing.assert_allclose(tool_frame.rotation, rotation, atol=1e-9)
        np.testing.assert_allclose(tool_frame.jacobian, expected, atol=1e-9)


@pytest.mark.parametrize("seed", range(6))
def test_rows_are_derivatives_of_h_along_the_true_motion(seed):
    """Rows of all links by finite differences along arcs; the columns of the base act on all spheres of the arm."""
    rng = np.random.default_rng(seed)
    config = msgspec.structs.replace(EXACT_TRACKING, acceleration_limits=False, precision="float64")
    safety, q = SafetyFilter(msgspec.structs.replace(BODY, base_lag=None), config), np.array(BODY.home)
    q[:3], q[3:] = rng.uniform(-2.0, 2.0, 3), np.clip(q[3:] + rng.uniform(-0.3, 0.3, 7), LOW, HIGH)
    centres, _, _ = safety.spheres(q, 0.0)
    obstacles = centres[rng.integers(0, len(centres), 5)] + rng.uniform(-0.25, 0.25, (5, 3))
    safety.observe([Obstacle(f"o{k}", Sphere(0.02), Pose(tuple(map(float, at)))) for k, at in enumerate(obstacles)])
    safety(q, np.zeros(9), np.zeros(9), opening=0.0)
    u = rng.uniform(-0.5, 0.5, 9)
    ahead, back = (safety.spheres(integrate_configuration(q, u, dt), 0.0)[0] for dt in (1e-5, -1e-5))
    safety.spheres(q, 0.0)
    rows = [row for row in safety._kernel.rows() if row[0] in (0, 1)]
    assert len(rows) > 10
    for kind, i, j, _, norm, _, a in rows:
        if kind == 0:
            gap = [np.linalg.norm(one[i] - obstacles[j]) for one in (ahead, back)]
        else:
            gap = [np.linalg.norm(one[i] - one[j]) for one in (ahead, back)]
        assert norm * np.dot(a, u) == pytest.approx((gap[0] - gap[1]) / 2e-5, abs=2e-5)
    moved = [np.abs(a[:2]).max() for kind, *_, a in rows if kind == 0]
    assert max(moved) > 0.1


def least_gap_after_one_step(base_lag, gap=2.5e-4, radius=0.05):
    """Least gap one period later, over moving bases that pass a post at `gap` [m]; relaxed results are skipped."""
    robot_model = msgspec.structs.replace(scenario_base(), base_lag=base_lag)
    rng, least, count = np.random.default_rng(1), 1.0, 0
    v_max = np.array([joint.velocity.value for joint in robot_model.joints])
    for _ in range(600):
        v, disc = rng.uniform(0.5, 1.0, 2) * v_max * rng.choice([-1.0, 1.0], 2), robot_model.spheres[rng.integers(4)]
        disc_velocity = v[0] * np.array([1.0, 0.0]) + v[1] * np.array([-disc.centre[1], disc.centre[0]])
        normal = rng.choice([-1.0, 1.0]) * np.array([-disc_velocity[1], disc_velocity[0]])
        post = np.array(disc.centre[:2]) + (disc.radius + radius + gap) * normal / np.linalg.norm(disc_velocity)
        if disc_distance(robot_model, np.zeros(3), post) - radius < gap - 1e-9:
            continue
        safety = SafetyFilter(robot_model, EXACT_TRACKING)
        safety.observe([Obstacle("post", Sphere(radius), Pose((*map(float, post), 0.0)))])
        safety.reset(v)
        result = safety(np.zeros(3), v, v)
        if result.status <= 1:
            count += 1
            q = integrate_configuration(np.zeros(3), result.u, robot_model.period)
            least = min(least, disc_distance(robot_model, q, post) - radius)
    assert count > 50
    return least


def disc_distance(robot_model, q, point):
    """Distance [m] of the discs of the footprint from a point."""
    c, s = np.cos(q[2]), np.sin(q[2])
    centres = np.array([sphere.centre[:2] for sphere in robot_model.spheres])
    discs = centres @ np.array([[c, s], [-s, c]]) + q[:2]
    return float(np.min(np.linalg.norm(discs - point, axis=1) - [sphere.radius for sphere in robot_model.spheres]))


def test_the_prediction_along_arcs_keeps_the_distance():
    """A straight step omits the sagitta of a period, v ω dt²/2, for which the sampling margin is not meant."""
    along, straight = least_gap_after_one_step(0.0), least_gap_after_one_step(None)
    assert straight < along - 8e-5
    assert along >= 2.0e-4


def test_a_lagging_base_is_predicted_along_its_arc():
    """With a base lag the filter uses the base pose to which the last command leads; the arm is not predicted."""
    robot_model = msgspec.structs.replace(BODY, base_lag=0.05)
    lagging, exact = SafetyFilter(robot_model), SafetyFilter(msgspec.structs.replace(robot_model, base_lag=0.0))
    q, v = np.array(BODY.home), np.array([0.4, 0.8, *np.zeros(7)])
    for safety in (lagging, exact):
        safety.observe([Obstacle("post", Sphere(0.05), Pose((0.9, 0.0, 0.2)))])
        safety.reset(v)
    predicted = integrate_configuration(q, v, 0.05)
    assert lagging(q, v, v).h_min == pytest.approx(exact(predicted, v, v).h_min, abs=1e-6)
