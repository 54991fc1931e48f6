"""Guarded servos: free actions arrive, unsafe ones do not touch, and faults bring the arm to rest with a reason."""

import numpy as np
import pytest

from dualbrain.errors import ConfigurationError
from dualbrain.safety.cbf.filter import SafetyFilter
from tests.safety.integration.servo_bus.ideal_servos import (
    KEYS,
    OBSTACLES,
    PERIOD,
    SO101,
    IdealServos,
    action,
    make_servos,
)

HOME = np.array(SO101.home)
FREE = HOME + np.array([0.3, -0.1, 0.0, 0.0, 0.5])
INTO_THE_TABLE = np.array([0.0, 1.0, 0.8, 0.5, 0.0])


def run(guarded, servos, periods, given=None, now=0.0, every=7):
    """Run `periods`, with the action `given` before every `every` of them; returns the time after them."""
    for period in range(periods):
        if given is not None and period % every == 0:
            guarded.begin(given, now)
        values = guarded.step(servos.read(), now)
        if values:
            servos.write(values)
        now += PERIOD
    return now


def start(goal=FREE, periods=40):
    """Guarded servos in a motion toward `goal`."""
    guarded, servos = make_servos(), IdealServos()
    now = run(guarded, servos, periods, action(goal))
    assert not guarded.state.problem
    return guarded, servos, now


def check_rest(guarded, servos, now, reason, given=None):
    """The arm comes to rest in a second, without a jump of the command, and the state has the reason."""
    before = servos.written[-1]
    now = run(guarded, servos, 200, given, now)
    assert reason in guarded.state.problem
    assert "the arm comes to rest" in guarded.state.problem
    assert "Remedy" in guarded.state.problem
    steps = [np.array([values[key] for key in KEYS[:5]]) for values in [before, *servos.written[-200:]]]
    moved = np.abs(np.diff(steps, axis=0)).max(axis=1)
    assert moved.max() <= np.degrees(1.05 * PERIOD)
    assert moved[-20:].max() < 1e-6
    return now


def test_a_free_action_arrives_and_the_gripper_passes_unchanged():
    guarded, servos, now = start(periods=400)
    assert servos.q == pytest.approx(FREE, abs=1e-3)
    assert not guarded.state.intervened
    assert {values["gripper.pos"] for values in servos.written} == {30.0}
    run(guarded, servos, 20, action(FREE, gripper=77.5), now)
    assert servos.written[-1]["gripper.pos"] == 77.5


def test_an_action_into_the_table_is_stopped_above_it_and_marked():
    guarded, servos, _ = start(INTO_THE_TABLE, periods=800)
    safety = SafetyFilter(SO101, obstacles=OBSTACLES)
    safety(servos.q, np.zeros(5), np.zeros(5), 0.0)
    assert min(row.h for row in safety.rows()) > 0.0
    assert guarded.state.intervened
    assert np.abs(servos.q - INTO_THE_TABLE).max() > 0.2


def test_without_an_action_nothing_is_written():
    guarded, servos = make_servos(), IdealServos()
    assert guarded.step(servos.read(), 0.0) is None
    assert not guarded.state.written
    guarded.begin({"elbow": 1.0}, PERIOD)
    assert guarded.step(servos.read(), PERIOD) is None
    assert "the action lacks shoulder_pan.pos" in guarded.state.problem


def test_the_command_begins_where_the_servos_hold_the_arm():
    guarded, servos = make_servos(), IdealServos()
    held = HOME + 0.05
    guarded.reset(action(held))
    guarded.begin(action(held), 0.0)
    written = guarded.step(servos.read(), 0.0)
    assert [written[key] for key in KEYS[:5]] == pytest.approx(np.degrees(held), abs=1e-6)


@pytest.mark.parametrize(
    ("given", "reason"),
    [
        ({**action(FREE), "elbow_flex.pos": float("nan")}, "elbow_flex.pos in the action is no finite number"),
        ({key: value for key, value in action(FREE).items() if "lift" not in key}, "lacks shoulder_lift.pos"),
        ({f"joint{i}.pos": 0.0 for i in range(6)}, "lacks shoulder_pan.pos"),
        (np.zeros(5), "no mapping of servo names but ndarray"),
        (None, "no mapping"),
    ],
)
def test_an_unusable_action_brings_the_arm_to_rest_and_a_good_one_moves_it_again(given, reason):
    guarded, servos, now = start()
    guarded.begin(given, now)
    now = check_rest(guarded, servos, now, reason)
    guarded.begin(action(FREE), now)
    run(guarded, servos, 400, action(FREE), now)
    assert servos.q == pytest.approx(FREE, abs=1e-3)
    assert not guarded.state.problem


def test_a_policy_that_stops_responding_brings_the_arm_to_rest():
    check_rest(*start(), "The last action ended")


def test_a_clock_that_jumps_back_brings_the_arm_to_rest():
    guarded, servos, now = start()
    guarded.begin(action(FREE), now - 100.0)
    guarded.step(servos.read(), now - 100.0)
    assert "is not after that of the last step" in guarded.state.problem
    assert "one monotonic clock" in guarded.state.problem


@pytest.mark.parametrize(
    "reading", [None, {}, {"elbow_flex.pos": 1.0}, {**action(FREE), "elbow_flex.pos": float("nan")}, [1.0] * 6]
)
def test_an_unusable_reading_stops_the_command(reading):
    guarded, servos, now = start()
    for period in range(80):
        values = guarded.step(reading, now + period * PERIOD)
        servos.write(values)
    moved = [np.array([values[key] for key in KEYS[:5]]) for values in servos.written[-30:]]
    assert np.ptp(moved, axis=0).max() < 1e-6
    assert "joint state" in guarded.state.problem


def test_a_joint_that_does_not_follow_stops_the_command():
    guarded, servos, now = start()
    stuck = servos.read()
    for period in range(300):
        if period % 7 == 0:
            guarded.begin(action(FREE + 1.0), now)
        guarded.step(stuck, now)
        now += PERIOD
    assert "from its commanded position, allowed are 0.35" in guarded.state.problem


def test_after_a_pause_the_motion_begins_at_rest():
    guarded, servos, now = start(HOME + np.array([1.0, 0.0, 0.0, 0.0, 0.0]), periods=60)
    now = run(guarded, servos, 1, action(FREE + 1.0), now + 1.0)
    step = abs(servos.written[-1]["shoulder_pan.pos"] - servos.written[-2]["shoulder_pan.pos"])
    assert np.radians(step) <= 1.05 * SO101.joints[0].acceleration.value * PERIOD**2


def test_one_call_per_action_is_the_same_filter_on_the_predicted_motion():
    guarded, servos, now = make_servos(), IdealServos(), 0.0
    assert guarded({"elbow": 1.0}, servos.read(), now) == {}
    for _ in range(120):
        now += 7 * PERIOD
        servos.write(guarded(action(INTO_THE_TABLE), servos.read(), now))
        for _ in range(6):
            servos.advance()
    safety = SafetyFilter(SO101, obstacles=OBSTACLES)
    safety(servos.q, np.zeros(5), np.zeros(5), 0.0)
    assert min(row.h for row in safety.rows()) > 0.0
    assert guarded.state.intervened


def test_a_far_goal_is_reached_without_overshoot():
    guarded, servos = make_servos(obstacles=()), IdealServos()
    goal = HOME + np.array([0.8, 0.0, -0.2, -0.1, 1.2])
    run(guarded, servos, 600, action(goal))
    path = np.radians([[values[key] for key in KEYS[:5]] for values in servos.written])
    shares = ((path - HOME) @ (goal - HOME)) / ((goal - HOME) @ (goal - HOME))
    assert shares.max() <= 1.0 + 1e-4
    assert shares[-1] == pytest.approx(1.0, abs=1e-6)
    assert (np.diff(shares) > -1e-4).all()


@pytest.mark.parametrize("reading", [None, {}, {KEYS[0]: 0.0}, dict.fromkeys(KEYS, float("nan"))])
def test_without_a_usable_reading_one_call_gives_no_values_not_even_for_the_gripper(reading):
    servos = make_servos()
    assert servos(action(HOME), reading, 0.0) == {}
    assert "not finite" in servos.state.problem
    with pytest.raises(ConfigurationError, match="no finite number for shoulder_"):
        servos.check_range(reading)


def test_a_first_reading_outside_of_the_range_of_a_joint_is_refused():
    make_servos().check_range(action(HOME))
    with pytest.raises(ConfigurationError, match=r"shoulder_pan.pos reads 200.0° after calibration.*calibration"):
        make_servos().check_range(action(HOME) | {KEYS[0]: 200.0})
