"""Joint drives: an exact lag, bounded compensation of loads, and no internal state after a stop."""

import mujoco
import numpy as np
import pytest

from dualbrain.errors import ConfigurationError, UnknownNameError
from dualbrain.robots.interface import Command
from dualbrain.simulation.plant.joint_drive import (
    DRIVE_KINDS,
    MAX_LOAD_SHARE,
    TORQUE_LAG,
    motor_slices,
    parse_drive_kind,
)
from dualbrain.simulation.plant.plant import Plant
from dualbrain.simulation.plant.stepped_plant import SteppedPlant
from dualbrain.simulation.scenes.scene_builder import PHYSICS_PERIOD
from dualbrain.simulation.scenes.scene_spec import SceneSpec
from tests.simulation.scripted_hand import HOME, PANDA, servo_to, top_down_posture, wait

EMPTY = SceneSpec(robot="panda", family="test", seed=0, objects=(), places=())
ALPHA = PANDA.alpha


def plant(**options):
    return Plant(EMPTY, PANDA, **options)


def drive_at(p, u, seconds):
    p.write(Command(np.asarray(u, float), 0.04, 20.0))
    wait(p, seconds)


def test_without_a_load_the_lag_is_first_order_to_a_thousandth():
    """Every joint covers 1/3 of the remaining difference to u in each step, and the integral stays zero."""
    p, u, share = (
        plant(),
        0.1 * np.array([0.3, -0.2, 0.3, -0.4, 0.5, -0.5, 0.6]),
        PHYSICS_PERIOD / (TORQUE_LAG + PHYSICS_PERIOD),
    )
    for k in range(1, 12):
        drive_at(p, u, PHYSICS_PERIOD)
        assert np.allclose(p.read().v / u, 1.0 - (1.0 - share) ** k, atol=1e-3)
    assert np.abs(p.drive.load).max() < 1e-2


def test_y_moves_at_u():
    """q + lag v integrates u during reversals, as the filter assumes, with an error below 1 % of lag times speed."""
    p, u = plant(), np.zeros(7)
    q0, total = p.read().q, np.zeros(7)
    for k in range(400):
        u = 0.3 * np.sin(0.05 * k) * np.array([1, -1, 1, 1, -1, 1, -1])
        drive_at(p, u, PHYSICS_PERIOD)
        total += u * PHYSICS_PERIOD
    state = p.read()
    assert np.abs(state.q + TORQUE_LAG * state.v - q0 - total).max() < 0.01 * TORQUE_LAG * 0.3


@pytest.mark.parametrize("load", [0.3, 1.0])
def test_a_load_is_compensated(load):
    """At a velocity command of zero, the arm sags by less than 2 e per kilogram and then rests; M and c exclude it."""
    p = plant(load=load)
    drive_at(p, np.zeros(7), 0.4)
    sag = np.abs(p.read().q - HOME)
    assert sag.max() < 2.0 * load * PANDA.tracking.position_error
    held = p.read().q
    wait(p, 0.4)
    assert np.abs(p.read().v).max() < 2e-4
    assert np.abs(p.read().q - held).max() < 2e-5
    jacobian = np.zeros((3, p.model.nv))
    mujoco.mj_jacSite(p.model, p.data, jacobian, None, p.model.site("robot/tcp").id)
    weight = jacobian[2, p.arm_slices[1]] * load * 9.81
    assert np.allclose(p.drive.load, weight, atol=0.02 * np.abs(weight).max() + 0.01)


def test_without_the_integral_a_load_moves_the_arm():
    """Negative control: with κ = 0, a load of 1 kg moves the joints."""
    p = plant(load=1.0)
    p.drive._integral_gain = 0.0
    drive_at(p, np.zeros(7), 0.4)
    assert np.abs(p.read().v).max() > 0.005


def press(p, height=-0.02):
    """Press the closed fingers against the table, towards `height` [m] below its top; returns the posture above."""
    above = top_down_posture(p, [0.5, 0.0, 0.02], 0.0)
    p.set_configuration(above)
    servo_to(p, top_down_posture(p, [0.5, 0.0, height], 0.0), 1.0, opening=0.0)
    return above


def test_pressing_winds_the_integral_up_to_its_bound_and_releases_slowly():
    p = plant()
    above = press(p)
    motors, _ = motor_slices(p.model)
    bound = MAX_LOAD_SHARE * p.model.actuator_forcerange[motors, 1]
    assert np.abs(p.drive.load).max() > 5.0, "the fingers press"
    assert np.all(np.abs(p.drive.load) <= bound)
    assert np.any(np.abs(p.drive.load) > 0.99 * bound)
    fastest = 0.0
    for _ in range(400):
        drive_at(p, np.clip(6.0 * (above - p.read().q), -0.2, 0.2), PHYSICS_PERIOD)
        fastest = max(fastest, np.abs(p.read().v).max())
    assert fastest < 0.3, "no jump beyond the command"


def test_the_overshoot_after_a_lost_contact_is_bounded():
    """From the bound of the integral without a load, the overshoot is at most 4 times bound / (M k²) and decays."""
    p = plant()
    p.drive.load[:] = 0.99 * p.drive._max_load
    q = p.read().q
    inertia = np.zeros((p.model.nv, p.model.nv))
    mujoco.mj_fullM(p.model, p.data, inertia)
    arm = inertia[p.arm_slices[1], p.arm_slices[1]]
    limit = np.abs(np.linalg.solve(arm, p.drive._max_load)) * 4.0 / p.drive.gain**2
    drive_at(p, np.zeros(7), 0.1)
    assert np.all(np.abs(p.read().q - q) < limit)
    assert np.abs(p.read().v).max() < 1e-3


def test_a_saturated_motor_does_not_wind_up():
    """After a step that the last motor cannot follow, its joint reaches the command without overshoot."""
    p, u = plant(), np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 2.5])
    fastest, saturated, motors = 0.0, False, motor_slices(p.model)[0]
    for _ in range(250):
        drive_at(p, u, PHYSICS_PERIOD)
        fastest = max(fastest, p.read().v[6])
        saturated |= bool(np.any(np.abs(p.data.ctrl[motors]) > p.model.actuator_forcerange[motors, 1]))
    assert saturated
    assert fastest == pytest.approx(2.5, rel=1e-2)


@pytest.mark.parametrize("event", ["stop", "set_configuration"])
def test_a_stop_resets_the_torque(event):
    p = plant(load=1.0)
    drive_at(p, np.zeros(7), 0.2)
    assert np.abs(p.drive.load).max() > 1.0
    p.stop() if event == "stop" else p.set_configuration(HOME)
    motors, _ = motor_slices(p.model)
    assert not p.drive.load.any()
    assert not p.data.ctrl[motors].any()
    if event == "stop":
        wait(p, 0.05)
        assert not p.drive.load.any(), "the drive is disabled"
        p.enable()
        wait(p, 0.3)
        assert np.abs(p.read().v).max() < 1e-3


def test_velocity_actuators_equal_those_of_the_model():
    """The split step with the drive in between gives the same state as MuJoCo's own step."""
    ours, bare = plant(drive="velocity"), plant(drive="velocity")
    motors, _ = motor_slices(bare.model)
    u = np.linspace(-0.05, 0.05, 7)
    ours.write(Command(u, 0.04, 20.0))
    bare.write(Command(np.zeros(7), 0.04, 20.0))
    for _ in range(50):
        ours.advance()
        bare.data.ctrl[motors] = u
        bare.data.ctrl[bare._gripper_actuator] = ours.data.ctrl[ours._gripper_actuator]
        mujoco.mj_step(bare.model, bare.data)
    assert np.array_equal(ours.data.qpos, bare.data.qpos)


@pytest.mark.parametrize("kind", DRIVE_KINDS)
def test_measure_and_apply_are_one_control_period(kind):
    whole, stepped = plant(drive=kind), SteppedPlant(plant(drive=kind))
    u = np.linspace(-0.1, 0.1, 7)
    for _ in range(30):
        whole.write(Command(u, 0.04, 5.0))
        whole.advance()
        stepped.measure()
        stepped.apply(u)
    assert np.array_equal(whole.read().q, stepped.q)


def test_unknown_drives_and_unsuitable_motors_are_rejected():
    with pytest.raises(UnknownNameError, match="velocity"):
        plant(drive="magnetic")
    assert tuple(map(parse_drive_kind, DRIVE_KINDS)) == DRIVE_KINDS
    p = plant()
    p.model.actuator_gear[0, 0] = 100.0
    with pytest.raises(ConfigurationError, match="gear 1"):
        motor_slices(p.model)
