"""The plant: robot interface, tracking, grip by contact, brakes, and visual meshes that do not change the physics."""

import msgspec
import numpy as np
import pytest

from dualbrain.core.geometry.shapes import Cylinder
from dualbrain.errors import ConfigurationError, UnknownNameError
from dualbrain.robots.interface import Command, RobotInterface
from dualbrain.simulation.models.mujoco_model import load_mujoco_model
from dualbrain.simulation.plant.joint_drive import DRIVE_KINDS
from dualbrain.simulation.plant.plant import Plant
from dualbrain.simulation.scenes.generators.tabletop import make_scene
from dualbrain.simulation.scenes.scene_spec import ObjectSpec
from tests.simulation.scripted_hand import HOME, PANDA, make_plant, pick_up, servo_to, top_down_posture, wait, yaw_of

VMAX = np.array([joint.velocity.value for joint in PANDA.joints])
AMAX = np.array([joint.acceleration.value for joint in PANDA.joints])
LAG, VELOCITY_ERROR = 0.002, {"computed_torque": 1e-3, "velocity": 0.03}
"""First-order lag [s] of both drives, and permitted velocity error [rad/s] at full acceleration."""
BALANCED_DRIVES = ("velocity", "computed_torque")
"""Drives that do not carry the weight of the arm; for position servos see test_position_servo.py."""


def test_a_plant_implements_the_robot_interface():
    robot: RobotInterface = make_plant()
    state = robot.read()
    assert state.q.shape == state.v.shape == (PANDA.n,)
    assert np.allclose(state.q, HOME)
    assert state.opening == pytest.approx(0.04)
    assert robot.read().sequence == state.sequence + 1


def test_time_advances_by_one_period():
    p = make_plant()
    wait(p, 0.25)
    assert p.now == pytest.approx(0.25)
    assert p.read().stamp == p.now


def nominal_velocity(mode, t):
    if mode == "sine":
        return 0.5 * VMAX * np.sin(2 * np.pi * np.array([0.5, 0.7, 0.9, 0.6, 1.1, 0.8, 1.3]) * t)
    return 0.5 * VMAX * np.array([1, -1, 1, -1, 1, -1, 1]) * (1 if int(t / 0.25) % 2 else -1)


@pytest.mark.parametrize("mode", ["sine", "bang"])
@pytest.mark.parametrize("drive", BALANCED_DRIVES)
def test_velocity_follows_as_a_first_order_lag(mode, drive):
    """lag·v̇ + v = u, stepped like the plant, within the declared error, at full acceleration of all joints."""
    p, u, model = make_plant(drive=drive), np.zeros(7), np.zeros(7)
    decay, worst = LAG / (LAG + 1e-3), np.zeros(7)
    for k in range(1200):
        u = u + np.clip(nominal_velocity(mode, k * 1e-3) - u, -AMAX * 1e-3, AMAX * 1e-3)
        p.write(Command(u, 0.04, 20.0))
        p.advance()
        model = decay * model + (1.0 - decay) * u
        worst = np.maximum(worst, np.abs(p.read().v - model))
    assert worst.max() < VELOCITY_ERROR[drive]


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_pick_by_contact_alone_lifts_the_cube(seed):
    p = make_plant("tabletop" if seed == 3 else "bare", seed)
    start = p.true_pose("red_cube").position[2]
    pick_up(p, "red_cube")
    assert p.true_pose("red_cube").position[2] > start + 0.13
    assert min(p.read().finger_forces) > 15.0


@pytest.mark.parametrize("force", [10.0, 60.0])
def test_the_grip_force_equals_the_command(force):
    p = make_plant("bare", 3)
    pose = p.true_pose("red_cube")
    q = top_down_posture(p, np.add(pose.position, [0, 0, 0.004]), yaw_of(pose))
    p.set_configuration(q)
    servo_to(p, q, 0.7, opening=0.0, force=force)
    measured = []
    servo_to(p, q, 0.3, opening=0.0, force=force, each=lambda: measured.append(p.read().finger_forces))
    assert np.allclose(np.mean(measured, axis=0), force, rtol=0.03)
    assert np.std(measured, axis=0).max() < 0.1, "stable at 1 kHz"


def test_the_finger_speed_is_limited():
    p = make_plant()
    p.write(Command(np.zeros(7), 0.0, 20.0))
    wait(p, 0.4)
    assert p.read().opening == pytest.approx(0.02, abs=0.003)
    wait(p, 0.5)
    assert p.read().opening < 0.001


@pytest.mark.parametrize("drive", DRIVE_KINDS)
def test_stop_engages_brakes_that_hold_the_arm(drive):
    p = make_plant(drive=drive)
    p.write(Command(0.5 * VMAX * np.array([1, 1, -1, 1, 1, -1, 1]), 0.04, 20.0))
    wait(p, 0.3)
    p.stop()
    assert not p.read().drive_enabled
    wait(p, 0.2)
    held = p.read().q
    p.write(Command(VMAX, 0.04, 20.0))
    wait(p, 1.5)
    assert np.abs(p.read().q - held).max() < 2e-3
    assert np.abs(p.read().v).max() < 2e-3


@pytest.mark.parametrize("drive", BALANCED_DRIVES)
def test_enable_releases_the_brakes_at_rest(drive):
    p = make_plant(drive=drive)
    p.stop()
    wait(p, 0.1)
    p.enable()
    wait(p, 0.3)
    assert np.abs(p.read().v).max() < 1e-3
    p.write(Command(np.full(7, 0.1), 0.04, 20.0))
    wait(p, 0.1)
    assert np.allclose(p.read().v, 0.1, atol=0.01)


def test_visual_meshes_do_not_change_the_physics():
    spec = make_scene("tabletop", 5)
    plain, with_meshes = Plant(spec, PANDA), Plant(spec, PANDA, visuals=True)
    assert with_meshes.has_visuals
    command = Command(np.array([0.3, 0.2, -0.1, 0.2, 0.1, 0.3, -0.2]), 0.01, 20.0)
    for p in (plain, with_meshes):
        p.write(command)
        wait(p, 0.3)
    assert np.array_equal(plain.data.qpos, with_meshes.data.qpos)


def test_two_plants_of_one_scene_are_bit_identical():
    first, second = make_plant("forearm", 2), make_plant("forearm", 2)
    for p in (first, second):
        p.write(Command(np.full(7, 0.2), 0.02, 20.0))
        wait(p, 0.3)
    assert np.array_equal(first.data.qpos, second.data.qpos)


def test_the_true_pose_of_an_unknown_object_is_an_error():
    p = make_plant("forearm", 0)
    assert p.true_pose("forearm").position[0] > 0.7
    with pytest.raises(UnknownNameError, match="red_cube"):
        p.true_pose("red_cub")


def test_a_user_file_without_required_elements_is_rejected(tmp_path):
    (tmp_path / "robot.xml").write_text("<mujoco><worldbody><body name='link0'/></worldbody></mujoco>")
    with pytest.raises(ConfigurationError, match="no body link1"):
        load_mujoco_model("panda", path=tmp_path / "robot.xml")
    (tmp_path / "broken.xml").write_text("<mujoco>")
    with pytest.raises(ConfigurationError, match="robot model file"):
        load_mujoco_model("panda", path=tmp_path / "broken.xml")
    with pytest.raises(UnknownNameError, match="panda"):
        load_mujoco_model("pandas")


@pytest.mark.parametrize(
    ("mass", "friction", "force", "held"),
    [(0.28, 0.12, 10.0, False), (0.28, 0.12, 20.0, True), (0.28, 0.8, 10.0, True)],
)
def test_a_full_wet_glass_slips_out_of_a_grip_that_holds_a_dry_one(mass, friction, force, held):
    """At 10 N, 2 μ F = 2.4 N is less than the weight of 2.7 N; for a dry glass the pads determine μ = 1.5."""
    glass = ObjectSpec(
        name="clear_glass",
        role="object",
        shape=Cylinder(0.024, 0.045),
        position=(0.5, 0.0, 0.045),
        mass=mass,
        colour="clear",
        category="glass",
        friction=friction,
    )
    p = Plant(msgspec.structs.replace(make_scene("bare", 0), objects=(glass,)), PANDA)
    pick_up(p, "clear_glass", force=force)
    assert (p.true_pose("clear_glass").position[2] > 0.15) is held
