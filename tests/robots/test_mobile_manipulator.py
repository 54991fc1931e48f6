"""An arm on a base: one chain whose tool and rows are those of an independent model, and whose rows hold on true
arcs."""

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


def test_it_is_the_arm_and_the_base_together():
    assert BODY.n == 9
    assert BODY.nq == 10
    assert BODY.is_mobile_manipulator
    assert BODY.alpha == PANDA.alpha
    assert BODY.joints[3:] == PANDA.joints[1:]
    assert set(PANDA.self_pairs.kept) < set(BODY.self_pairs.kept)
    assert ("base", "hand") in BODY.self_pairs.kept
    assert isinstance(SafetyFilter(BODY)._kernel, _kernel_wide.Kernel)
    assert not any(link.frame == 0 for link in BODY.links), "what drives is bolted to nothing"


def test_its_parts_are_an_arm_and_a_base_again():
    arm, base = extract_arm(BODY), extract_base(BODY)
    assert [link.frame for link in arm.links] == [link.frame for link in PANDA.links]
    assert arm.spheres == PANDA.spheres
    assert arm.self_pairs.kept == PANDA.self_pairs.kept
    assert (base.n, base.nq, base.is_mobile, base.is_mobile_manipulator) == (2, 3, True, False)
    with pytest.raises(ConfigurationError, match="mobile manipulator"):
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
def test_the_balls_hold_housing_and_pedestal(middle, half):
    rng = np.random.default_rng(0)
    points = np.array(middle) + np.array(half) * rng.uniform(-1.0, 1.0, (4000, 3))
    inside = np.zeros(len(points), bool)
    for ball in extract_base(BODY).spheres:
        inside |= np.linalg.norm(points - ball.centre, axis=1) <= ball.radius
    assert inside.all()


def test_tool_and_jacobian_are_those_of_mujoco():
    """The plant's model is written apart from the body: its joints are x, y, yaw and the arm's."""
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
        ours = safety.tool(q)
        wanted = np.column_stack([x * np.cos(q[2]) + y * np.sin(q[2]), yaw, J[:, arm]])
        position, rotation = plant.tool_pose()
        np.testing.assert_allclose(ours.position, position, atol=1e-9)
        np.testing.assert_allclose(ours.rotation, rotation, atol=1e-9)
        np.testing.assert_allclose(ours.jacobian, wanted, atol=1e-9)


@pytest.mark.parametrize("seed", range(6))
def test_rows_are_derivatives_of_h_along_the_true_motion(seed):
    """Every row of every part of the body, by differences along arcs; the base's columns act on all spheres of the
    arm."""
    rng = np.random.default_rng(seed)
    config = msgspec.structs.replace(EXACT_TRACKING, acceleration_limits=False, precision="float64")
    safety, q = SafetyFilter(msgspec.structs.replace(BODY, base_lag=None), config), np.array(BODY.home)
    q[:3], q[3:] = rng.uniform(-2.0, 2.0, 3), np.clip(q[3:] + rng.uniform(-0.3, 0.3, 7), LOW, HIGH)
    where, _, _ = safety.spheres(q, 0.0)
    spots = where[rng.integers(0, len(where), 5)] + rng.uniform(-0.25, 0.25, (5, 3))
    safety.observe([Obstacle(f"o{k}", Sphere(0.02), Pose(tuple(map(float, at)))) for k, at in enumerate(spots)])
    safety(q, np.zeros(9), np.zeros(9))
    u = rng.uniform(-0.5, 0.5, 9)
    ahead, back = (safety.spheres(integrate_configuration(q, u, dt), 0.0)[0] for dt in (1e-5, -1e-5))
    safety.spheres(q, 0.0)
    rows = [row for row in safety._kernel.rows() if row[0] in (0, 1)]
    assert len(rows) > 10
    for kind, i, j, _, norm, _, a in rows:
        if kind == 0:
            gap = [np.linalg.norm(one[i] - spots[j]) for one in (ahead, back)]
        else:
            gap = [np.linalg.norm(one[i] - one[j]) for one in (ahead, back)]
        assert norm * np.dot(a, u) == pytest.approx((gap[0] - gap[1]) / 2e-5, abs=2e-5)
    moved = [np.abs(a[:2]).max() for kind, *_, a in rows if kind == 0]
    assert max(moved) > 0.1


def least_after_one_step(base_lag, gap=2.5e-4, radius=0.05):
    """Least gap one period later, over bases at speed that pass a post at `gap` [m]; no answer relaxed."""
    robot_model, rng, least, count = (
        msgspec.structs.replace(scenario_base(), base_lag=base_lag),
        np.random.default_rng(1),
        1.0,
        0,
    )
    fast = np.array([joint.velocity.value for joint in robot_model.joints])
    for _ in range(600):
        v, disc = rng.uniform(0.5, 1.0, 2) * fast * rng.choice([-1.0, 1.0], 2), robot_model.spheres[rng.integers(4)]
        way = v[0] * np.array([1.0, 0.0]) + v[1] * np.array([-disc.centre[1], disc.centre[0]])
        out = rng.choice([-1.0, 1.0]) * np.array([-way[1], way[0]]) / np.linalg.norm(way)
        post = np.array(disc.centre[:2]) + (disc.radius + radius + gap) * out
        if nearest(robot_model, np.zeros(3), post) - radius < gap - 1e-9:
            continue
        safety = SafetyFilter(robot_model, EXACT_TRACKING)
        safety.observe([Obstacle("post", Sphere(radius), Pose((*map(float, post), 0.0)))])
        safety.reset(v)
        answer = safety(np.zeros(3), v, v)
        if answer.status <= 1:
            count += 1
            least = min(
                least,
                nearest(robot_model, integrate_configuration(np.zeros(3), answer.u, robot_model.period), post) - radius,
            )
    assert count > 50
    return least


def nearest(body, q, post):
    """Distance of the footprint's discs from a point."""
    c, s = np.cos(q[2]), np.sin(q[2])
    discs = np.array([ball.centre[:2] for ball in body.spheres]) @ np.array([[c, s], [-s, c]]) + q[:2]
    return float(np.min(np.linalg.norm(discs - post, axis=1) - [ball.radius for ball in body.spheres]))


def test_a_base_that_is_taken_along_its_arcs_keeps_its_distance():
    """A straight step leaves out the sagitta of a period, v ω dt²/2; the sampling margin is for other things."""
    along, straight = least_after_one_step(0.0), least_after_one_step(None)
    assert straight < along - 8e-5
    assert along >= 2.0e-4


def test_what_lags_is_ahead_along_its_arc():
    """With a lag of its own the base stands where its last command takes it; the arm stays where it is."""
    robot_model = msgspec.structs.replace(BODY, base_lag=0.05)
    safety, late = SafetyFilter(robot_model), SafetyFilter(msgspec.structs.replace(robot_model, base_lag=0.0))
    q, v = np.array(BODY.home), np.array([0.4, 0.8, *np.zeros(7)])
    thing = [Obstacle("post", Sphere(0.05), Pose((0.9, 0.0, 0.2)))]
    for one in (safety, late):
        one.observe(thing)
        one.reset(v)
    ahead = integrate_configuration(q, v, 0.05)
    assert safety(q, v, v).h_min == pytest.approx(late(ahead, v, v).h_min, abs=1e-6)
