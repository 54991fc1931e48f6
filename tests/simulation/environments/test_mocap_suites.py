"""`guard_fetch` and `guard_metaworld` without their suites: names, time steps, actions, and the arm in the model."""

from dataclasses import replace

import gymnasium
import mujoco
import numpy as np
import pytest

from dualbrain.errors import ConfigurationError, UnknownNameError
from dualbrain.robots.collision_model.coverage import SphereSet, are_covered
from dualbrain.robots.collision_model.self_collision import random_configurations
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.safety.integration.derating import derate
from dualbrain.simulation.environments import guard_fetch, guard_metaworld
from dualbrain.simulation.environments.mocap.arm_model import ArmLimits, make_arm_model
from dualbrain.simulation.environments.mocap.gymnasium_robotics import fetch_robot
from dualbrain.simulation.environments.mocap.metaworld import metaworld_robot
from tests.simulation.environments.mocap_suites import HEIGHT, MocapSuite

GUARDS = {"fetch": guard_fetch, "metaworld": guard_metaworld}
ROBOTS = {"fetch": fetch_robot, "metaworld": metaworld_robot}
SUITES = tuple(GUARDS)
DOWN = (0.0, 0.0, -1.0, 0.3)


def random_actions(seed, steps=150):
    rng = np.random.default_rng(seed)
    for step in range(steps):
        if step % 12 == 0:
            action = rng.choice([-1.0, 1.0], 4)
            action[2] = -1.0 if step % 24 == 0 else action[2]
        yield action


POLICIES = {
    "down": lambda: [DOWN] * 120,
    "sideways": lambda: [(0.3, 1.0, -1.0, 0.0)] * 60 + [(-0.3, -1.0, -1.0, 0.0)] * 60,
    "random": lambda: random_actions(3),
}


def run(suite, env, actions):
    """Whether the arm touches the table, the last `info`, the least h, and the least height of the tool [m]."""
    env.reset(seed=0)
    touched, info, least, low = False, {}, np.inf, np.inf
    for action in actions:
        info = env.step(np.asarray(action, np.float32))[4]
        touched |= suite.touches()
        least = min(least, info.get("h_min", np.inf))
        low = min(low, float(height(suite)))
    return touched, info, least, low


def height(suite):
    return suite.data.body(suite.tool).xpos[2] - suite.top


@pytest.mark.parametrize("policy", POLICIES)
@pytest.mark.parametrize("name", SUITES)
def test_no_hostile_policy_touches_the_table_behind_the_guard(name, policy):
    inner = MocapSuite(name)
    assert run(inner, inner, POLICIES[policy]())[0], "the policy is hostile"
    touched, info, least, low = run(inner, GUARDS[name](inner), POLICIES[policy]())
    assert not touched
    assert least > 0.0
    assert info["applied"].dtype == np.float32
    assert low < HEIGHT - 0.02, "free space is used"


@pytest.mark.parametrize("name", SUITES)
def test_the_gripper_passes_and_the_object_of_the_task_is_no_obstacle(name):
    inner = MocapSuite(name)
    env = GUARDS[name](inner)
    env.reset(seed=0)
    assert env.step(np.array(DOWN, np.float32))[4]["applied"][3] == np.float32(0.3)
    names = {one.name for one in env.safety.tables.obstacles}
    assert any("table" in one for one in names)
    assert not any("object0" in one or "obj/" in one for one in names)


@pytest.mark.parametrize("speed", [0.003, 0.01])
def test_a_torso_that_rises_takes_no_distance_from_the_table(speed):
    """In the simulation of Fetch the torso rises during an episode, which no joint of the arm shows."""
    inner = MocapSuite("fetch", torso_speed=speed)
    env = guard_fetch(inner)
    actions = [DOWN] * 150 + [(1.0, 0.5, 0.0, 0.0)] * 20 + [(-1.0, -0.5, 0.0, 0.0)] * 40
    touched, _, least, _ = run(inner, env, actions)
    risen = inner.data.joint("robot0:torso_lift_joint").qpos[0]
    assert risen > 190 * inner.dt * speed
    assert not touched
    assert least > -1e-3


@pytest.mark.parametrize("name", SUITES)
def test_the_model_is_that_of_the_simulation_and_made_once(name):
    inner = MocapSuite(name)
    robot_model = ROBOTS[name](inner)
    assert ROBOTS[name](MocapSuite(name)) is robot_model
    q = random_configurations(robot_model.joints, 1, np.random.default_rng(5))[0]
    for joint, value in zip(inner.joints, q, strict=True):
        inner.data.joint(joint).qpos[0] = value
    for finger in ("right_finger", "left_finger"):
        joint = inner.model.joint(int(inner.model.body(finger).jntadr[0]))
        inner.data.qpos[joint.qposadr[0]] = 0.03
    mujoco.mj_kinematics(inner.model, inner.data)
    base = inner.data.body("robot0:torso_lift_link" if name == "fetch" else "right_arm_base_link").xpos
    safety = SafetyFilter(robot_model)
    np.testing.assert_allclose(safety.tool(q).position, inner.data.body(inner.tool).xpos - base, atol=1e-6)
    centres, radii, _ = safety.spheres(q, None)
    cover, uncovered = SphereSet(centres + base, radii), 0
    for body in (*(f"right_l{k}" for k in range(7)), inner.tool, "right_finger", "left_finger"):
        if name == "fetch" and body.startswith("right_l"):
            continue
        points = surface(inner, body)
        assert are_covered(points, cover, tolerance=1e-4).all(), body
        uncovered += not are_covered(points, SphereSet(cover.centres, 0.8 * radii)).all()
    assert uncovered >= 2, "smaller spheres would not do"


def surface(inner, body):
    """Points (k, 3) on the only geom of a body: a capsule or a box."""
    geom, rng = int(inner.model.body(body).geomadr[0]), np.random.default_rng(0)
    size = inner.model.geom_size[geom]
    points = rng.normal(size=(400, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    if inner.model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_BOX:
        points = points / np.abs(points).max(axis=1, keepdims=True) * size
    else:
        points = points * size[0] + np.where(points[:, 2:] > 0.0, 1.0, -1.0) * np.array([0.0, 0.0, size[1]])
    return points @ inner.data.geom_xmat[geom].reshape(3, 3).T + inner.data.geom_xpos[geom]


@pytest.mark.parametrize("bad", [None, np.zeros(2), np.zeros((2, 4)), np.full(4, np.nan), [0.0, np.inf, 0.0, 0.0]])
@pytest.mark.parametrize("deviation", [0.02, 1e-5])
def test_an_unusable_action_brings_the_tool_to_rest(bad, deviation):
    inner = MocapSuite("metaworld")
    env = guard_metaworld(inner, deviation=deviation)
    run(inner, env, [(0.5, 0.5, -0.5, 0.3)] * 20)
    for _ in range(5):
        before = inner.data.mocap_pos[0].copy()
        info = env.step(bad)[4]
        assert info["applied"].shape == (4,)
        assert np.isfinite(info["applied"]).all()
    assert np.linalg.norm(inner.data.mocap_pos[0] - before) < 1e-3
    assert "Remedy" in info["safety"]


LIMITS = ArmLimits(velocity=1.0, acceleration=10.0, tool_speed=1.0, period=0.01)


@pytest.mark.parametrize("name", SUITES)
def test_the_period_of_a_given_robot_model_is_kept_or_refused(name):
    inner = MocapSuite(name)
    robot_model = ROBOTS[name](inner)
    env = GUARDS[name](inner, derate(robot_model, period=inner.dt / 8))
    assert (env.safety.robot_model.period, env.guard.steps_per_action) == (inner.dt / 8, 8)
    with pytest.raises(ConfigurationError, match="multiple of the period"):
        GUARDS[name](inner, derate(robot_model, period=0.007))


@pytest.mark.parametrize("wrong", [{"period": 0.02}, {"period": 0.0}, {"velocity": 0.0}, {"tool_speed": -1.0}])
def test_limits_of_an_arm_that_no_filter_keeps_are_refused(wrong):
    with pytest.raises(ConfigurationError, match=f"ArmLimits.{next(iter(wrong))}"):
        replace(LIMITS, **wrong)


@pytest.mark.parametrize(
    ("base", "tool", "error"), [("table", "hand", ConfigurationError), ("base", "grip", UnknownNameError)]
)
def test_a_tool_that_the_base_does_not_carry_is_refused(base, tool, error):
    inner = MocapSuite("metaworld")
    with pytest.raises(error, match=tool):
        make_arm_model(inner.model, inner.data, "arm", base=base, tool=tool, joints=inner.joints, limits=LIMITS)


@pytest.mark.slow
def test_the_guard_fits_the_real_fetch():
    """Gymnasium-robotics with actions toward the table: no finger touches it, and the arm is that of the suite."""
    suite = pytest.importorskip("gymnasium_robotics")
    gymnasium.register_envs(suite)
    env = guard_fetch(gymnasium.make("FetchReach-v4", max_episode_steps=200))
    env.reset(seed=0)
    least = min(env.step(np.array([0.3, -0.3, -1.0, 0.0], np.float32))[4]["h_min"] for _ in range(60))
    assert 0.0 < least < 0.01


@pytest.mark.slow
def test_the_guard_fits_the_real_metaworld():
    """The wall of metaworld stops the hand, and the arm is that of the suite."""
    suite = pytest.importorskip("metaworld")
    benchmark = suite.MT1("reach-wall-v3", seed=0)
    inner = benchmark.train_classes["reach-wall-v3"]()
    inner.set_task(benchmark.train_tasks[0])
    env = guard_metaworld(inner)
    env.reset()
    infos = [env.step(np.array([0.0, 1.0, -1.0, 0.0], np.float32))[4] for _ in range(150)]
    assert 0.0 < min(info["h_min"] for info in infos) < 0.01
    assert infos[-1]["status"] == "MODIFIED"
