"""Inverse dynamics against MuJoCo's, for fixed arms and for an arm on a moving base."""

import msgspec
import mujoco
import numpy as np
import pytest

from dualbrain.errors import ConfigurationError
from dualbrain.robots.loader import find_model_faults, load_robot
from dualbrain.safety.contact_force.arm_dynamics import GRAVITY, ArmDynamics
from dualbrain.simulation.models.mujoco_model import load_mujoco_model
from dualbrain.simulation.plant.factory import make_plant
from dualbrain.simulation.scenes.generators.catalogue import open_scene

TORQUE_TOLERANCE = 1e-3
"""Largest accepted difference [Nm]: the masses in the model are rounded to six digits."""


@pytest.mark.parametrize("robot", ["panda", "ur5e"])
def test_the_torque_of_a_motion_is_mujocos(robot):
    model = load_mujoco_model(robot).spec.compile()
    model.body_gravcomp[:] = 0.0
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT) | int(mujoco.mjtDisableBit.mjDSBL_LIMIT)
    data, dynamics, n = mujoco.MjData(model), ArmDynamics(load_robot(robot)), load_robot(robot).n
    rng = np.random.default_rng(0)
    for _ in range(50):
        q, v, acceleration = rng.uniform(-1.5, 1.5, (3, n))
        data.qpos[:n], data.qvel[:n], data.qacc[:n] = q, v, acceleration
        mujoco.mj_inverse(model, data)
        assert np.abs(dynamics.torque(q, v, acceleration).own - data.qfrc_inverse[:n]).max() < TORQUE_TOLERANCE


def test_the_torque_of_a_moving_base_is_mujocos():
    robot_model = load_robot("mobile_panda")
    plant = make_plant(open_scene("workroom", "mobile_panda"), robot_model)
    model, data = plant.model, plant.data
    model.body_gravcomp[:] = 0.0
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT) | int(mujoco.mjtDisableBit.mjDSBL_LIMIT)
    _, arm = plant.arm_slices
    base = slice(arm.start - 3, arm.start)
    rng, dynamics = np.random.default_rng(1), ArmDynamics(robot_model)
    for _ in range(20):
        heading, (speed, spin, faster, turn) = rng.uniform(-3.0, 3.0), rng.uniform(-0.4, 0.4, 4)
        q, v, acceleration = rng.uniform(-1.0, 1.0, (3, 7))
        c, s = np.cos(heading), np.sin(heading)
        plant.set_configuration(np.array([0.1, 0.2, heading, *q]), 0.0)
        data.qvel[base] = speed * c, speed * s, spin
        data.qvel[arm] = v
        data.qacc[:] = 0.0
        data.qacc[base] = faster * c - speed * spin * s, faster * s + speed * spin * c, turn
        data.qacc[arm] = acceleration
        mujoco.mj_inverse(model, data)
        got = dynamics.torque(
            np.array([0.1, 0.2, heading, *q]),
            np.array([speed, spin, *v]),
            np.array([faster, turn, *acceleration]),
        )
        assert np.abs(got.own - data.qfrc_inverse[arm]).max() < TORQUE_TOLERANCE


def test_one_kilogram_at_the_tool_weighs_as_much():
    robot_model = load_robot("panda")
    still = np.zeros(7)
    torque = ArmDynamics(robot_model).torque(np.array(robot_model.home), still, still)
    assert np.linalg.norm(torque.wrist_per_load[:3]) == pytest.approx(GRAVITY)
    assert abs(torque.per_load[0]) < 1e-9  # the axis of the first joint is vertical


def test_a_robot_that_declares_sensing_needs_masses():
    robot_model = msgspec.structs.replace(load_robot("panda"), dynamics=None)
    assert [entry for entry, _, _ in find_model_faults(robot_model)] == ["dynamics"]
    with pytest.raises(ConfigurationError, match="no dynamic model"):
        ArmDynamics(robot_model)


@pytest.mark.parametrize(
    ("part", "changes", "entry"),
    [
        ("force_sensing", {"noise": (0.1,)}, "noise of force_sensing"),
        ("force_sensing", {"accuracy": (float("nan"),) * 7}, "accuracy of force_sensing"),
        ("force_sensing", {"kind": "wrist_wrench"}, "noise of force_sensing"),
        ("dynamics", {"damping": (-1.0,) * 7}, "damping of dynamics"),
    ],
)
def test_wrong_entries_are_named(part, changes, entry):
    panda = load_robot("panda")
    changed = msgspec.structs.replace(panda, **{part: msgspec.structs.replace(getattr(panda, part), **changes)})
    assert entry in [name for name, _, _ in find_model_faults(changed)]
