"""The guard of robosuite environments, with a stand-in of robosuite's interface, and with robosuite if installed."""

from types import SimpleNamespace

import numpy as np
import pytest

from dualbrain.errors import ConfigurationError, UnknownNameError
from dualbrain.simulation.environments import guard_robosuite, robosuite_robot
from tests.simulation.environments.robosuite_env import HOME, STEPS, Lift

STILL = np.zeros(8)


def hostile_run(env, step, seed, steps=60):
    """Contacts of the arm while every joint is driven to the end of its range, in changing directions."""
    rng, found = np.random.default_rng(seed), set()
    for k in range(steps):
        if k % 8 == 0:
            action = rng.choice([-1.0, 1.0], 8)
        info = step(action)[3]
        found |= env.contacts()
        assert info["own"] == 1
    return found, info


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_hostile_actions_cause_no_contact(seed):
    env = Lift()
    guarded = guard_robosuite(env)
    contacts, info = hostile_run(env, guarded.step, seed)
    assert not contacts
    assert info["h_min"] > 0.0
    allowed = guarded.safety.robot_model.tracking.position_errors(7)
    assert np.all(info["tracking_error"] <= allowed), "the joints follow within the margins of the filter"
    assert np.all(info["tracking_error"] > 0.0)


def test_the_same_actions_cause_contacts_without_the_guard():
    found = [hostile_run(env, env.step, seed)[0] for seed, env in ((0, Lift()), (1, Lift()))]
    assert all(found)


def test_a_torque_that_is_safe_reaches_the_motors_bit_for_bit():
    bare, env = Lift(), Lift()
    guarded = guard_robosuite(env)
    action = np.array([0.004, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.7])
    for _ in range(4):
        expected = bare.step(action)
        found = guarded.step(action)
        assert env.received[-1] is action
        assert not found[3]["changed"]
        assert found[3]["status"] == "SAFE"
        assert found[1:3] == expected[1:3]
    np.testing.assert_array_equal(env.torques, bare.torques)


def test_the_action_itself_with_its_gripper_entry_is_never_changed():
    env = Lift()
    guarded = guard_robosuite(env)
    action = np.append(np.ones(7), 0.3)
    assert guarded.step(action)[3]["changed"]
    assert env.received[-1] is action
    np.testing.assert_array_equal(action, np.append(np.ones(7), 0.3))


@pytest.mark.parametrize(
    "bad", [np.full(8, np.nan), np.ones(3), "left", None], ids=["not finite", "another size", "text", "none"]
)
def test_an_unusable_action_brings_the_arm_to_rest_and_keeps_the_gripper(bad):
    env = Lift()
    guarded = guard_robosuite(env)
    for _ in range(6):
        guarded.step(np.append(np.full(7, 0.3), 0.6))
    assert np.abs(env.v).max() > 0.1
    for _ in range(12):
        info = guarded.step(bad)[3]
        assert "the action" in info["safety"]
        assert "comes to rest" in info["safety"]
        assert env.received[-1][7] == 0.6
    assert np.abs(env.v).max() < 1e-3
    guarded.step(np.append(np.full(7, 0.3), 0.6))
    assert np.abs(env.v).max() > 0.01, "the next usable action moves the arm"


def test_a_model_that_a_reset_builds_again_is_used():
    env = Lift()
    guarded = guard_robosuite(env)
    before = guarded.safety
    env.crate_at = (0.45, -0.25)
    assert guarded.reset() == {"q": HOME}
    assert guarded.safety is not before
    assert not hostile_run(env, guarded.step, 3)[0]
    env.crate_at = (2.0, 2.0)
    guarded.reset()
    free = guarded.step(STILL)[3]["h_min"]
    env.crate_at = (0.6, 0.0)
    guarded.reset()
    assert guarded.step(STILL)[3]["h_min"] < free


def test_manipulated_bodies_are_no_obstacles_and_all_others_are():
    assert guard_robosuite(Lift()).ignored == ("cube_main",)
    assert guard_robosuite(Lift(), manipulated=("crate", "cube_main")).ignored == ("crate", "cube_main")
    assert guard_robosuite(Lift(), manipulated=()).ignored == ()
    with pytest.raises(UnknownNameError, match="ball"):
        guard_robosuite(Lift(), manipulated=("ball",))


def test_the_interface_is_that_of_the_environment():
    env = Lift()
    guarded = guard_robosuite(env)
    assert guarded.action_dim == 8
    assert guarded._check_success() is False
    assert guarded.env is env
    with pytest.raises(AttributeError, match="renderer"):
        _ = guarded.renderer
    for _ in range(2):
        guarded.step(STILL)
    assert len(env.torques) == 2 * STEPS


def test_the_robot_model_has_the_period_of_the_physics_and_slower_joints():
    model = robosuite_robot(Lift())
    assert model.period == 0.002
    assert model.tracking.drive == "robosuite"
    assert model.joints[0].velocity.value == pytest.approx(0.25 * 2.175)


def with_robot(**changes):
    env = Lift()
    for name, value in changes.items():
        setattr(env.robots[0], name, value)
    return env


class Unlisted(Lift):
    """A task whose objects the guard does not know."""


@pytest.mark.parametrize(
    ("env", "message"),
    [
        (SimpleNamespace(), "no environment of robosuite"),
        (with_robot(name="Sawyer"), "'Sawyer'.*Panda"),
        (with_robot(arms=["right", "left"]), "one arm"),
        (with_robot(gripper={"right": object()}), "PandaGripper.*gripper_types"),
        (
            with_robot(part_controllers={"right": SimpleNamespace(name="JOINT_VELOCITY")}),
            "JOINT_VELOCITY.*OSC_POSE.*controller_configs",
        ),
        (Unlisted(), "touch in Unlisted are unknown.*manipulated="),
    ],
    ids=["no robosuite", "robot", "two arms", "gripper", "controller", "task"],
)
def test_an_environment_that_cannot_be_guarded_is_refused_with_a_remedy(env, message):
    with pytest.raises(ConfigurationError, match=message):
        guard_robosuite(env)


def test_actuators_that_are_no_torque_motors_are_refused():
    env = Lift()
    env.sim.model._model.actuator_gear[env.motors[2], 0] = 2.0
    with pytest.raises(ConfigurationError, match="do not exert the torques"):
        guard_robosuite(env)


@pytest.mark.slow
def test_robosuite_itself_if_it_is_installed():
    robosuite = pytest.importorskip("robosuite")
    env = robosuite.make(
        "Lift", robots="Panda", has_renderer=False, has_offscreen_renderer=False, use_camera_obs=False, seed=0
    )
    guarded = guard_robosuite(env)
    guarded.reset()
    for _ in range(40):
        *_, info = guarded.step(np.array([0.0, 0.0, -1.0, 0.0, 0.0, 0.0, -1.0]))
        assert not env.check_contact(env.robots[0].robot_model, "table_collision")
    assert info["changed"]
