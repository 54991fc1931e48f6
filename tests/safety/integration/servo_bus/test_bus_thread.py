"""The bus thread: one writer, the newest action, and faults of the bus, of the policy and of other senders."""

import threading
import time

import numpy as np
import pytest

from dualbrain.errors import ConfigurationError
from dualbrain.safety.integration.servo_bus.bus_thread import SENDER_MEMORY, BusThread
from tests.safety.integration.servo_bus.ideal_servos import KEYS, PERIOD, SO101, IdealServos, action, make_servos

HOME = np.array(SO101.home)
FREE = HOME + np.array([0.3, -0.1, 0.0, 0.0, 0.5])


class Clock:
    """A clock that a test moves [s]."""

    def __init__(self):
        self.now = 100.0

    def __call__(self):
        return self.now


def make_bus():
    """A bus whose periods a test runs, on a clock of its own; nothing waits for a thread."""
    servos, clock = IdealServos(), Clock()
    return BusThread(make_servos(), servos.read, servos.write, clock=clock), servos, clock


def post(bus, given):
    """Make `given` the newest action without a thread that answers."""
    with bus._changed:
        bus._action, bus._waiting, bus._sent = given, True, bus._sent + 1


def run(bus, clock, periods, given=None):
    for period in range(periods):
        if given is not None and period % 7 == 0:
            post(bus, given)
        bus.run_period()
        clock.now += PERIOD


def test_the_newest_action_counts_and_nothing_is_written_before_the_first():
    bus, servos, clock = make_bus()
    run(bus, clock, 20)
    assert not servos.written
    post(bus, action(FREE + 1.0))
    post(bus, action(HOME))
    run(bus, clock, 7)
    assert [servos.written[-1][key] for key in KEYS[:5]] == pytest.approx(np.degrees(HOME), abs=1e-6)
    assert len(servos.written) == 7
    assert bus.timing.periods == 27


@pytest.mark.parametrize("side", ["read", "write"])
def test_a_bus_that_fails_brings_the_arm_to_rest_and_recovers(side):
    bus, servos, clock = make_bus()
    run(bus, clock, 70, action(FREE))

    def fail(values):
        raise ConnectionError("no answer of motor 3")

    good = servos.write
    if side == "read":
        servos.broken = "no answer of motor 3"
    else:
        bus._write = fail
    run(bus, clock, 100)
    assert "no answer of motor 3; the arm comes to rest. Remedy: check cable and power" in bus.state.problem
    servos.broken, bus._write = "", good
    run(bus, clock, 60)
    moved = [np.array([values[key] for key in KEYS[:5]]) for values in servos.written[-20:]]
    assert np.ptp(moved, axis=0).max() < 1e-6
    run(bus, clock, 500, action(FREE))
    assert not bus.state.problem
    assert servos.q == pytest.approx(FREE, abs=2e-3)


def test_an_intervention_is_taken_once():
    bus, _, clock = make_bus()
    run(bus, clock, 30, action(FREE))
    assert not bus.take_intervention()
    post(bus, None)
    run(bus, clock, 1)
    assert bus.take_intervention()
    post(bus, action(FREE))
    run(bus, clock, 1)
    assert not bus.take_intervention()


def test_late_periods_are_counted_and_many_are_logged(caplog):
    bus, _, clock = make_bus()
    run(bus, clock, 10)
    clock.now += 0.1
    run(bus, clock, 10)
    assert bus.timing.late == 1
    assert bus.timing.longest == pytest.approx(0.1 + PERIOD)
    bus.stop()
    assert not caplog.text
    clock.now += 0.1
    run(bus, clock, 1)
    bus.stop()
    assert "2 of 21 periods of the servo bus began late, the longest after 105 ms" in caplog.text


def start_thread(servos=None, **options):
    servos = servos or IdealServos()
    bus = BusThread(make_servos(), servos.read, servos.write, **options)
    bus.start()
    return bus, servos


@pytest.mark.realtime
def test_the_thread_moves_the_arm_between_two_actions():
    bus, servos = start_thread()
    for _ in range(30):
        state = bus.send(action(FREE))
        time.sleep(1 / 30)
    bus.stop()
    assert state.written["gripper.pos"] == 30.0
    assert not state.problem
    assert len(servos.written) > 100
    assert servos.q == pytest.approx(FREE, abs=0.05)
    moved = np.diff([[values[key] for key in KEYS[:5]] for values in servos.written], axis=0)
    assert np.abs(moved).max() <= np.degrees(1.01 * PERIOD)


@pytest.mark.realtime
def test_send_returns_what_was_written_for_its_action():
    bus, servos = start_thread()
    for value in (10.0, 20.0, 30.0):
        assert bus.send(action(HOME, gripper=value)).written["gripper.pos"] == value
        assert any(values["gripper.pos"] == value for values in servos.written)
    bus.stop()


@pytest.mark.realtime
def test_two_senders_bring_the_arm_to_rest():
    bus, _ = start_thread()
    bus.send(action(FREE))
    states = []
    other = threading.Thread(target=lambda: states.append(bus.send(action(HOME))))
    other.start()
    other.join()
    assert "Two threads send actions; the arm comes to rest" in states[0].problem
    time.sleep(SENDER_MEMORY + 0.1)
    assert not bus.send(action(FREE)).problem
    bus.stop()


def test_a_thread_that_does_not_run_or_has_ended_is_an_error_with_the_cause():
    servos = IdealServos()
    bus = BusThread(make_servos(), servos.read, servos.write)
    with pytest.raises(ConfigurationError, match=r"does not run\. Connect the robot first"):
        bus.send(action(FREE))
    bus.servos.step = lambda reading, now: 1 / 0
    bus.start()
    with pytest.raises(ConfigurationError, match="already"):
        bus.start()
    with pytest.raises(ConfigurationError, match="has ended: division by zero"):
        bus.send(action(FREE))
    bus.stop()
    assert not bus.is_running


@pytest.mark.realtime
def test_a_new_session_does_not_carry_out_an_action_of_the_one_before():
    bus, servos = start_thread()
    bus.send(action(HOME))
    bus.refuse("the operator left")
    bus.stop()
    post(bus, action(FREE))
    bus._problem = "of the last session"
    written = len(servos.written)
    bus.start(servos.read())
    time.sleep(0.3)
    assert (bus.state.problem, bus.state.written) == ("", {})
    assert len(servos.written) == written
    bus.stop()


@pytest.mark.realtime
def test_stop_forgets_an_action_that_no_period_has_taken():
    bus, servos = start_thread()
    bus.send(action(HOME))
    bus.stop()
    post(bus, action(FREE))
    bus.stop()
    written = len(servos.written)
    bus.run_period()
    assert len(servos.written) == written + 1
    assert servos.goal[:5] == pytest.approx(np.degrees(HOME), abs=0.05)


@pytest.mark.realtime
def test_an_action_that_the_bus_does_not_answer_is_withdrawn_and_reported(caplog):
    bus, servos = start_thread()
    bus.send(action(HOME))
    free, good = threading.Event(), servos.read

    def hang():
        free.wait(5.0)
        return good()

    bus._read = hang
    time.sleep(3 * PERIOD)
    state = bus.send(action(FREE))
    assert "The bus has not answered for 0.5 s" in state.problem
    assert "Remedy: check cable and port" in state.problem
    assert "The bus has not answered" in caplog.text
    free.set()
    time.sleep(0.5)
    assert servos.goal[:5] == pytest.approx(np.degrees(HOME), abs=0.1)
    assert not bus.send(action(FREE)).problem
    bus.stop()


def send_from(bus, sender, given):
    """Send as the thread `sender`, without a thread that answers."""
    return bus._post(given, sender)


def test_every_action_is_refused_while_two_senders_are_active():
    """The second sender is three times as fast: its second action in a row must not move the arm either."""
    bus, servos, clock = make_bus()
    run(bus, clock, 70, action(HOME))
    clock.now += 1.0
    run(bus, clock, 1)
    for cycle in range(60):
        send_from(bus, 1 if cycle % 3 == 0 else 2, action(HOME if cycle % 3 == 0 else FREE))
        run(bus, clock, 2)
        assert cycle == 0 or "Two threads send actions" in bus.state.problem
    moved = np.array([[values[key] for key in KEYS[:5]] for values in servos.written])
    assert np.abs(moved - np.degrees(HOME)).max() < 0.1
    clock.now += SENDER_MEMORY
    send_from(bus, 2, action(FREE))
    run(bus, clock, 1)
    assert not bus.state.problem


def test_a_slow_policy_is_still_a_sender_after_two_of_its_periods():
    servos, clock = IdealServos(), Clock()
    bus = BusThread(make_servos(action_rate=1.0), servos.read, servos.write, clock=clock)
    send_from(bus, 1, action(HOME))
    clock.now += 1.5
    send_from(bus, 2, action(FREE))
    run(bus, clock, 1)
    assert "Two threads send actions" in bus.state.problem
