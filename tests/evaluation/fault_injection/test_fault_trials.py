"""A sample of injected faults: the declared action follows, and the independent monitor finds nothing unsafe."""

from itertools import product

import numpy as np
import pytest

from dualbrain.errors import UnknownNameError
from dualbrain.evaluation.fault_injection.faults import EXPECTED_ACTIONS, KINDS, MOMENTS, SOURCES, Fault, draw_moment
from dualbrain.evaluation.fault_injection.trial import MotionRecorder, run_fault_trial
from dualbrain.records import Violation
from dualbrain.robots.interface import Command
from dualbrain.robots.loader import load_robot
from dualbrain.safety.supervisor.actions import SafetyAction
from dualbrain.simulation.scenes.generators.catalogue import open_scene
from dualbrain.simulation.world import make_world

SAMPLE = [
    ("state", "off", "closing"),
    ("state", "garbage", "carrying"),
    ("scene", "garbage", "closing"),
    pytest.param("scene", "stuck", "carrying", marks=pytest.mark.slow),
    ("clock", "stuck", "between write and acknowledgement"),
    ("qp", "off", "closing"),
    ("qp", "garbage", "descending"),
    pytest.param("qp", "stuck", "carrying", marks=pytest.mark.slow),
    ("qp", "slow", "closing"),
    ("drive", "stuck", "closing"),
    pytest.param("drive", "off", "carrying", marks=pytest.mark.slow),
    ("socket", "garbage", "closing"),
    ("socket", "stuck", "carrying"),
]


def test_every_fault_has_a_declared_action():
    assert set(EXPECTED_ACTIONS) == set(product(SOURCES, KINDS))
    with pytest.raises(UnknownNameError, match="kind of fault"):
        Fault("state", "of", "closing")
    with pytest.raises(UnknownNameError, match="moment"):
        Fault("state", "off", "never")
    assert len(MOMENTS) == 6


def test_moments_are_drawn_reproducibly():
    drawn = [draw_moment(seed) for seed in range(100)]
    assert set(drawn) == set(MOMENTS)
    assert drawn == [draw_moment(seed) for seed in range(100)]


@pytest.mark.parametrize(("source", "kind", "moment"), SAMPLE)
def test_a_fault_leads_to_its_declared_action_and_to_no_unsafe_violation(source, kind, moment):
    report = run_fault_trial(Fault(source, kind, moment), scene="bare:0")
    assert report.struck is not None
    assert report.as_declared, report
    assert report.safe, report
    assert report.rest is not None
    assert report.rest < 1.5
    assert SafetyAction[report.reached] >= SafetyAction[report.expected] > SafetyAction.NONE
    assert report.outcome in ("stopped", "emergency")


def test_malformed_proposals_are_refused_and_the_running_contract_continues():
    report = run_fault_trial(Fault("planner", "garbage", "closing"), scene="bare:0")
    assert report.struck is not None
    assert report.safe, report
    assert (report.reached, "frames_refused" in report.checks) == ("WARN", True)
    assert report.outcome == "succeeded", report


@pytest.mark.parametrize(
    ("source", "kind", "scene"),
    [
        ("state", "garbage", "boxes:0"),
        ("scene", "stuck", "crossing:1"),
        ("clock", "wrong", "boxes:0"),
        ("qp", "slow", "boxes:0"),
        ("drive", "off", "crossing:1"),
        ("socket", "off", "crossing:1"),
    ],
)
def test_a_base_at_full_speed_is_stopped_as_declared(source, kind, scene):
    report = run_fault_trial(Fault(source, kind, "closing"), robot="base", scene=scene)
    assert report.struck is not None
    assert report.as_declared, report
    assert report.safe, report
    assert report.other == ()
    assert "program_error" not in report.checks


def test_a_base_that_drives_below_a_resting_arm_moves():
    """A collision of a robot that rests is not counted as unsafe."""
    robot, recorder = load_robot("mobile_panda"), MotionRecorder()
    world = make_world(open_scene("boxes:1", robot.name), robot, pace=recorder)
    recorder.observe(world.plant)
    world.plant.enable()
    for _ in range(50):
        world.plant.write(Command(u=np.array([0.3, *np.zeros(robot.n - 1)]), opening=0.0, force=10.0))
        world.advance()
    assert np.abs(world.plant.robot_velocity()[2:]).max() < 0.001
    bodies = ("link5", "box_1")
    touch = Violation(kind="collision_env", start=world.plant.now, duration=0.0, peak=1.0, bodies=bodies)
    assert recorder.was_moving_during(touch)
    assert recorder.time_to_rest(0.0) is None


@pytest.mark.parametrize(
    ("start", "moves", "is_unsafe"),
    [
        (1.0, (0.0, 0.0), False),
        (1.0, (1.5, 4.0), True),  # at rest when the contact begins, then it presses on
        (1.6, (1.5, 1.7), True),
        (1.6, (0.0, 1.3), False),
        (1.0, (1.5, 1.51), False),  # a push by the person
    ],
)
def test_a_contact_counts_as_unsafe_if_the_robot_moves_before_or_during_it(start, moves, is_unsafe):
    recorder, time = MotionRecorder(), [0.0]
    recorder._speed = lambda: 0.5 if moves[0] < time[0] < moves[1] else 0.0
    for number in range(1, 500):
        time[0] = 0.01 * number
        recorder(time[0])
    touch = Violation(
        kind="collision_human", start=start, duration=4.0 - start, peak=120.0, bodies=("forearm", "link5")
    )
    assert recorder.was_moving_during(touch) == is_unsafe


@pytest.mark.parametrize(
    ("robot", "source", "kind", "moment", "scene", "check"),
    [
        ("fr3", "qp", "slow", "closing", "bare:0", "loop_behind"),
        ("panda", "scene", "stuck", "closing", "forearm:0", "scene_frozen"),
        ("ur5e", "scene", "stuck", "grasping", "forearm:0", "scene_frozen"),
        ("ur5e", "scene", "stuck", "between write and acknowledgement", "forearm:0", "scene_frozen"),
    ],
)
def test_faults_that_were_once_unsafe_are_detected_in_time(robot, source, kind, moment, scene, check):
    report = run_fault_trial(Fault(source, kind, moment), robot=robot, scene=scene)
    assert report.safe, report
    assert report.as_declared, report
    assert check in report.checks
    assert report.reaction is not None
    assert report.reaction < 0.15
