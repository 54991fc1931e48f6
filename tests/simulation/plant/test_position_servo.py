"""Position servos sag and lag by their own law; with the identified tracking error the guard keeps h above zero."""

import msgspec
import numpy as np
import pytest

from dualbrain.robots.interface import Command
from dualbrain.safety.cbf.filter import FilterConfig, SafetyFilter
from dualbrain.safety.integration.derating import derate
from dualbrain.safety.integration.policy_guard.guard import PolicyGuard
from dualbrain.safety.integration.policy_guard.joint_actions import JointPosition
from dualbrain.simulation.identification.tracking_model import identify_plant
from dualbrain.simulation.plant.plant import Plant
from dualbrain.simulation.plant.position_servo import FULL_TORQUE_ERROR, MAX_ERROR
from dualbrain.simulation.scenes.scene_spec import SceneSpec
from tests.safety.integration.gym_environments import OBSTACLES, min_h
from tests.simulation.scripted_hand import HOME, PANDA, wait

EMPTY = SceneSpec(robot="panda", family="test", seed=0, objects=(), places=())
TORQUE_LIMITS = np.array([87.0, 87.0, 87.0, 87.0, 12.0, 12.0, 12.0])


def servo_arm(robot_model=PANDA, **options):
    return Plant(EMPTY, robot_model, drive="position", **options)


def slow_panda():
    """A Panda within limits that its servos can follow: 0.25 rad/s and 2 rad/s²."""
    slow = derate(PANDA, max_speed=0.25)
    joints = [
        msgspec.structs.replace(joint, acceleration=msgspec.structs.replace(joint.acceleration, value=2.0))
        for joint in slow.joints
    ]
    return msgspec.structs.replace(slow, joints=tuple(joints))


def test_the_arm_sags_until_the_servos_carry_its_weight():
    p = servo_arm()
    wait(p, 1.5)
    sag = p.drive.target - p.read().q
    weight = p.data.qfrc_gravcomp[p.arm_slices[1]]  # the torque that would balance the arm
    assert np.abs(p.read().v).max() < 1e-3
    np.testing.assert_allclose(sag * TORQUE_LIMITS / FULL_TORQUE_ERROR, weight, atol=0.02)
    assert np.abs(sag).max() > 0.01
    np.testing.assert_array_equal(p.drive.target, HOME)


def test_a_load_that_the_servos_do_not_know_adds_to_the_sag():
    empty, loaded = servo_arm(), servo_arm(load=1.0)
    for p in (empty, loaded):
        wait(p, 1.5)
    sags = [np.abs(p.drive.target - p.read().q).max() for p in (empty, loaded)]
    assert sags[1] > sags[0] + 0.003


def test_the_command_integrates_the_control_and_a_blocked_servo_does_not_wind_up():
    p = servo_arm()
    p.write(Command(np.full(7, 0.1), 0.04, 20.0))
    wait(p, 0.5)
    np.testing.assert_allclose(p.drive.target, HOME + 0.05, atol=1e-3)
    p.write(Command(np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]), 0.04, 20.0))
    wait(p, 4.0)  # the fourth joint is at its end
    assert abs(p.drive.target[3] - p.read().q[3]) <= MAX_ERROR + 1e-9
    assert p.drive.target[3] - p.read().q[3] > 0.5 * MAX_ERROR


def test_a_stop_commands_the_position_at_which_the_arm_is():
    p = servo_arm()
    wait(p, 0.5)
    p.stop()
    np.testing.assert_array_equal(p.drive.target, p.read().q)


def guarded_path(robot_model, config, seconds=12.0):
    """Measured joint angles of a careless position policy behind the guard, every 5 ms."""
    plant, rng, path = servo_arm(robot_model), np.random.default_rng(0), []
    guard = PolicyGuard(SafetyFilter(robot_model, config, obstacles=OBSTACLES), JointPosition(), period=0.02)
    guard.reset(plant.drive.target)
    for action in range(round(seconds / 0.02)):
        if action % 100 == 0:
            goal = HOME + rng.uniform(-1.2, 1.2, 7)
        guard.begin(guard.target + np.clip(goal - guard.target, -0.05, 0.05), plant.read().stamp)
        for step in range(20):
            state = plant.read()
            result = guard.step(state.q, state.v, state.stamp)
            plant.write(Command(result.u, 0.04, 20.0))
            plant.advance()
            if step % 5 == 0:
                path.append(state.q)
    assert not guard.report.problem
    return np.array(path)


@pytest.fixture(scope="module")
def identified():
    found = identify_plant(slow_panda(), "position", seeds=(0, 1), seconds=5.0, load=0.0)
    return slow_panda().with_tracking(found.to_error_model("position", "test")).with_drive("position")


def test_the_identified_tracking_error_of_servos_is_that_of_their_sag(identified):
    assert 0.005 < identified.tracking.lag < 0.05
    errors = identified.tracking.position_errors(7)
    assert 0.01 < max(errors) < FULL_TORQUE_ERROR
    assert min(errors) < 0.2 * max(errors), "the joints that carry the weight sag most"


def test_with_the_identified_tracking_error_no_servo_brings_h_below_zero(identified):
    assert min_h(guarded_path(identified, FilterConfig())) > 0.0


def test_without_a_margin_for_the_tracking_error_they_do():
    exact = FilterConfig(lag_compensation=False, tracking_error=0.0)
    assert min_h(guarded_path(slow_panda(), exact)) < 0.0
