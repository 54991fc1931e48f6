"""Environments of others in MuJoCo: obstacles against MuJoCo's own distances, the arm's joints, and closed loops."""

from types import SimpleNamespace

import gymnasium
import mujoco
import numpy as np
import pytest

from dualbrain.core.geometry.distance import signed_distance
from dualbrain.errors import ConfigurationError, UnknownNameError
from dualbrain.robots.loader import load_robot
from dualbrain.safety.cbf.config import FilterConfig
from dualbrain.safety.integration.derating import derate
from dualbrain.safety.integration.policy_guard.joint_actions import JointVelocity
from dualbrain.simulation.environments import MujocoArm, MujocoObstacles, guard_mujoco_env
from dualbrain.simulation.environments.guarded_mujoco_env import mujoco_handles
from tests.simulation.environments.arm_env import BASE, HOME, JOINTS, PROBE_RADIUS, ArmEnv

PANDA = load_robot("panda")
SLOW_PANDA = derate(PANDA, period=ArmEnv.dt, max_speed=1.5)
EXACT = FilterConfig(lag_compensation=False, tracking_error=0.0)


@pytest.fixture
def env():
    env = ArmEnv()
    env.reset(seed=0)
    return env


def arm_of(env, **changes):
    arguments = {"robot_model": PANDA, "joints": JOINTS, "base": BASE} | changes
    return MujocoArm(env.model, env.data, **arguments)


def obstacles_by_geom(env, **options):
    found = MujocoObstacles(arm_of(env), **options).observe()
    return {obstacle.name.partition("/")[2]: obstacle for obstacle in found}


def smallest_distance(env):
    """Smallest distance of a moving part of the arm from everything else that collides, by MuJoCo [m]."""
    arm = arm_of(env)
    own = [g for g in range(env.model.ngeom) if int(env.model.geom_bodyid[g]) in arm.bodies - {arm.base}]
    rest = [
        g
        for g in range(env.model.ngeom)
        if int(env.model.geom_bodyid[g]) not in arm.bodies and env.model.geom_contype[g]
    ]
    return min(mujoco.mj_geomDistance(env.model, env.data, a, b, 1.0, None) for a in own for b in rest)


# --- obstacles ------------------------------------------------------------------------------------------------------


def test_all_geoms_that_collide_are_obstacles_and_no_part_of_the_arm_is(env):
    names = {"table", "ball", "post", "crate", "can", "egg", "stone", "panel"}
    assert set(obstacles_by_geom(env)) == names
    assert set(obstacles_by_geom(env, ignored=("swinging_panel",))) == names - {"panel"}


def test_an_obstacle_is_at_the_place_and_of_the_size_of_its_geom(env):
    """Distances of probes in the frame of the base: equal for primitives, not larger for shapes in a box."""
    arm, rng = arm_of(env), np.random.default_rng(0)
    turn, origin = env.data.xmat[arm.base].reshape(3, 3), env.data.xpos[arm.base]
    for name, obstacle in obstacles_by_geom(env).items():
        geom = env.model.geom(name).id
        smallest = np.inf
        for probe in rng.uniform(-1.0, 1.0, (400, 3)):
            exact = point_distance(env, geom, origin + turn @ probe)
            found = signed_distance(obstacle.shape, obstacle.pose, probe)
            if name in ("can", "egg", "stone"):
                assert found <= exact + 1e-6, name
                smallest = min(smallest, exact - found)
            elif exact > 0.0:
                assert found == pytest.approx(exact, abs=1e-6), name
        if name in ("can", "egg", "stone"):
            assert smallest < 0.05, f"the box around {name} is tight"


def point_distance(env, geom, point):
    """Distance of a point from a geom by MuJoCo, through a small sphere that collides with nothing."""
    env.data.mocap_pos[0] = point
    mujoco.mj_kinematics(env.model, env.data)
    probe = env.model.geom("probe").id
    return mujoco.mj_geomDistance(env.model, env.data, geom, probe, 10.0, None) + PROBE_RADIUS


def test_a_moving_geom_has_the_velocity_of_its_centre_and_the_speed_of_its_surface_about_it(env):
    env.swing(2.0)
    before, static = obstacles_by_geom(env)["panel"], obstacles_by_geom(env)["crate"]
    assert static.static
    assert not before.static
    assert static.velocity == (0.0, 0.0, 0.0)
    assert np.linalg.norm(before.velocity) == pytest.approx(2.0 * 0.1)
    assert before.velocity_error == pytest.approx(2.0 * np.linalg.norm([0.02, 0.1, 0.2]))
    env.data.qpos[env.model.joint("swing").qposadr[0]] += 1e-5 * 2.0
    env.swing(2.0)
    moved = np.subtract(obstacles_by_geom(env)["panel"].pose.position, before.pose.position)
    np.testing.assert_allclose(moved / 1e-5, before.velocity, atol=1e-4)


def test_a_margin_enlarges_every_obstacle(env):
    assert {obstacle.margin for obstacle in obstacles_by_geom(env, margin=0.02).values()} == {0.02}


# --- the arm --------------------------------------------------------------------------------------------------------


def test_joints_are_read_by_name_in_the_order_of_the_robot_model(env):
    q = HOME + 0.1 * np.arange(7)
    env.set_posture(q)
    np.testing.assert_array_equal(arm_of(env).q, q)
    env.step(np.append(np.arange(7) / 10.0, 0.0))
    np.testing.assert_allclose(arm_of(env).v, np.arange(7) / 10.0)


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        (
            {"joints": (JOINTS[1], JOINTS[0], *JOINTS[2:])},
            ConfigurationError,
            "'arm/joint2' of the environment is not the",
        ),
        ({"joints": JOINTS[:6]}, ConfigurationError, "one for each joint of panda"),
        ({"joints": ("swing", *JOINTS[1:])}, ConfigurationError, "lever arm to the tool by"),
        ({"joints": ("arm/finger_joint1", *JOINTS[1:])}, ConfigurationError, "is not revolute, as 'panda_joint1' is"),
        ({"joints": ("joint1", *JOINTS[1:])}, UnknownNameError, "joint1"),
        ({"base": "swinging_panel"}, ConfigurationError, "'swinging_panel' moves"),
        ({"base": "link0"}, UnknownNameError, "link0"),
        ({"base": "world"}, ConfigurationError, "lever arm to the tool by"),
    ],
    ids=["permuted", "count", "another joint", "another kind", "unknown joint", "moving base", "unknown base", "world"],
)
def test_another_arm_is_refused_with_the_first_joint_that_differs(env, changes, error, message):
    with pytest.raises(error, match=message):
        arm_of(env, **changes)


def test_another_robot_is_refused(env):
    with pytest.raises(ConfigurationError, match="is not the joint"):
        arm_of(env, robot_model=load_robot("ur5e"), joints=JOINTS[:6])


# --- closed loops ---------------------------------------------------------------------------------------------------


def careless_run(env, guarded, seconds=4.0):
    """Smallest distance of the arm from everything else while it moves to random postures at full speed."""
    env.reset(seed=1)
    rng, least = np.random.default_rng(2), np.inf
    for step in range(round(seconds / ArmEnv.dt)):
        if step % 160 == 0:
            goal = HOME + rng.uniform(-1.5, 1.5, 7)
        inner = env.unwrapped
        _, _, _, _, info = env.step(np.append(np.clip(3.0 * (goal - inner.posture), -1.5, 1.5), 0.5))
        if step % 4 == 0:
            least = min(least, smallest_distance(inner))
        if guarded:
            assert info["status"] in ("SAFE", "MODIFIED", "RELAXED"), info["safety"]
    return least


def test_a_careless_policy_touches_nothing_behind_the_filter():
    assert careless_run(ArmEnv(), guarded=False) < 0.0
    guarded = guard_mujoco_env(ArmEnv(), SLOW_PANDA, JointVelocity(), joints=JOINTS, base=BASE, config=EXACT)
    assert careless_run(guarded, guarded=True) > 0.0


def test_a_model_that_a_reset_builds_again_is_used():
    env = ArmEnv(rebuilt=True)
    guarded = guard_mujoco_env(env, SLOW_PANDA, JointVelocity(), joints=JOINTS, base=BASE, config=EXACT)
    guarded.reset(seed=1)
    limit = PANDA.joints[3].upper.value
    env.set_posture(np.where(np.arange(7) == 3, limit - 0.01, HOME))
    env.swing(0.0)
    for _ in range(40):
        guarded.step(np.array([0.0, 0.0, 0.0, 1.5, 0.0, 0.0, 0.0, 0.0]))
        assert env.posture[3] < limit


def test_the_entry_for_the_gripper_passes_unchanged():
    guarded = guard_mujoco_env(ArmEnv(), SLOW_PANDA, JointVelocity(), joints=JOINTS, base=BASE, config=EXACT)
    guarded.reset(seed=0)
    assert guarded.step(np.append(np.full(7, 9.0), 0.25))[4]["applied"][7] == 0.25


def test_an_environment_whose_actions_are_slower_than_the_arm_is_refused():
    env = ArmEnv()
    env.action_space = gymnasium.spaces.Box(-1.0, 1.0, (8,), np.float64)
    with pytest.raises(ConfigurationError, match=r"joint velocities .* must not be clipped") as slow:
        guard_mujoco_env(env, SLOW_PANDA, JointVelocity(), joints=JOINTS, base=BASE, config=EXACT)
    assert "max_speed" in slow.value.fix
    slower = derate(PANDA, period=ArmEnv.dt, max_speed=1.0)
    guard_mujoco_env(env, slower, JointVelocity(), joints=JOINTS, base=BASE, config=EXACT)


def test_an_environment_without_a_simulation_is_refused():
    with pytest.raises(ConfigurationError, match="CartPoleEnv has no MuJoCo simulation"):
        guard_mujoco_env(gymnasium.make("CartPole-v1"), PANDA, JointVelocity(), base=BASE)


@pytest.mark.parametrize("suite", ["gymnasium", "robosuite", "dm_control", "gym-aloha"])
def test_the_simulation_is_found_where_each_suite_keeps_it(env, suite):
    one = SimpleNamespace
    physics = one(model=one(ptr=env.model), data=one(ptr=env.data))
    holder = {
        "gymnasium": one(model=env.model, data=env.data),
        "robosuite": one(sim=one(model=one(_model=env.model), data=one(_data=env.data))),
        "dm_control": one(physics=physics),
        "gym-aloha": one(_env=one(physics=physics)),
    }[suite]
    assert mujoco_handles(holder) == (env.model, env.data)
