"""The executive by its own clock, on the host: rates, resets, and messages that come too early."""

import os
import re
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from dualbrain.robots.interface import home_state
from dualbrain.robots.loader import load_robot
from dualbrain.safety.cbf.config import operating_config
from dualbrain.safety.supervisor.actions import SafetyAction
from dualbrain.safety.supervisor.checks import CHECKS
from dualbrain.safety.supervisor.conditions import Condition
from dualbrain.safety.supervisor.controller import SafetyController
from dualbrain.safety.target.frames import encode_frame
from dualbrain.safety.target.link import PipeLink
from dualbrain.safety.target.messages import Message, pack_reset
from dualbrain.safety.target.session import TargetLostError, TargetSession
from dualbrain.safety.target.target_filter import TargetFilter
from tests.firmware.hosted_firmware import HostedTarget, load_firmware, refused_by_pass

UR5E = load_robot("ur5e")
PERIOD = UR5E.period
STEP = PERIOD * min(joint.acceleration.value for joint in UR5E.joints)
"""Change of the velocity in one period at the acceleration limit of every joint [rad/s]."""
LAST = np.eye(UR5E.n)[-1]
"""Only the last joint moves, so that the arm is far from its limit of the speed."""


@pytest.fixture(scope="module")
def library(tmp_path_factory):
    return load_firmware(tmp_path_factory.mktemp("firmware"), UR5E)


@pytest.fixture
def target(library):
    return HostedTarget(library, UR5E)


def move(target, speed):
    """Accelerate the last joint to `speed` [rad/s]; the last reply."""
    v = np.zeros(UR5E.n)
    for _ in range(round(speed / STEP) + 2):
        reply = target.cycle(speed * LAST, v)
        v = reply.u[: UR5E.n]
    assert reply.u[: UR5E.n] == pytest.approx(speed * LAST, rel=1e-3)
    return reply


def test_without_a_host_the_arm_brakes_at_its_acceleration_limit(target):
    """A period of 2 ms: one output per period, each with the acceleration of one period."""
    acceleration = np.array([joint.acceleration.value for joint in UR5E.joints])
    moves, outputs = [(target.now, move(target, 0.5).u[: UR5E.n])], []
    for _ in range(300):
        target.wait(1000)
        outputs += (found := target.replies())
        moves += [(target.now, reply.u[: UR5E.n]) for reply in found]
    for (earlier, before), (later, after) in pairwise(moves[1:]):
        if later - earlier < 0.02 and after.any():
            assert later - earlier >= 0.999 * PERIOD
            assert (np.abs(after - before) <= 1.001 * acceleration * (later - earlier)).all()
    assert sum(u.any() for _, u in moves) > 10
    assert CHECKS[outputs[0].check].name == "state_stale"
    assert (outputs[-1].action, outputs[-1].drive_enabled) == (SafetyAction.ESTOP, False)


def reset(target, u):
    """Send a RESET to `u` [rad/s] of the last joint."""
    target.session.send(Message.RESET, pack_reset((u * LAST).tolist(), [0.0] * UR5E.n))


@pytest.mark.parametrize("speed", [0.0, 0.5])
def test_a_reset_that_would_make_the_control_jump_is_refused(target, speed):
    """With the measured velocity at the last control; the next control is within its acceleration limit."""
    before = move(target, speed)
    for jump in (2.1 * STEP, -2.1 * STEP, 1.0):
        reset(target, speed + jump)
        reply = target.cycle(speed * LAST, speed * LAST)
        assert reply.refused == before.refused + 1
        assert reply.conditions & Condition.FRAMES_REFUSED
        assert reply.u[: UR5E.n] == pytest.approx(speed * LAST, abs=1e-3)
        before = reply


@pytest.mark.parametrize(("u", "v"), [(1.9 * STEP, 0.0), (0.5, 0.5), (0.2, 0.5), (0.5 - 1.9 * STEP, 0.5)])
def test_a_reset_near_the_last_control_or_the_measured_velocity_is_applied(target, u, v):
    """The host continues from a measured or reported velocity, as at the start of a session with a moving arm."""
    before = move(target, 0.0)
    reset(target, u)
    reply = target.cycle(u * LAST, v * LAST)
    assert reply.refused == before.refused
    assert reply.u[: UR5E.n] == pytest.approx(u * LAST, rel=1e-3)


def test_a_moving_arm_may_continue_at_rest_once_it_is_at_rest(target):
    before = move(target, 0.5)
    reset(target, 0.0)
    reply = target.cycle(0.0, 0.0)
    assert (reply.refused, reply.u.any()) == (before.refused, False)


def test_no_reset_moves_an_arm_under_a_pause(target):
    before = move(target, 0.0)
    target.cycle(0.0, 0.0, Condition.PAUSE)
    for count in range(1, 20):
        reset(target, 1.9 * STEP)
        reply = target.cycle(LAST, 0.0, Condition.PAUSE)
        assert (reply.action, reply.u.any()) == (SafetyAction.HOVER, False)
        assert reply.refused == before.refused + count


def test_a_reset_to_a_lower_speed_is_applied_under_a_pause(target):
    before = move(target, 0.5)
    reset(target, 0.5 - 1.5 * STEP)
    reply = target.cycle(0.5 * LAST, 0.5 * LAST, Condition.PAUSE)
    assert reply.refused == before.refused
    assert reply.u[: UR5E.n] == pytest.approx((0.5 - 2.5 * STEP) * LAST, rel=1e-3)


def test_a_reset_of_a_former_session_has_no_effect(target):
    move(target, 0.0)
    reset(target, 0.5)
    target.open()
    assert not target.cycle(0.0, 0.5 * LAST).u.any()


def test_a_pass_of_the_main_loop_handles_one_message_and_waits_only_without_bytes(library):
    """The clock is read before the first pass and once in each."""
    torn = b"\2\1\0"
    assert refused_by_pass(library, 5 * torn) == [0, 1, 2, 3, 4, 5, 5]
    assert refused_by_pass(library, b"") == [0, 0]
    assert refused_by_pass(library, bytes([255]) * 3000 + torn) == [0, 0, 0, 1, 1]


def send_too_early(target, conditions):
    """Send more CYCLEs than are accepted, and then one with `conditions`, which is refused."""
    for _ in range(8):
        target.send_cycle(0.0, 0.0)
    assert len(target.replies()) < 8
    target.send_cycle(0.0, 0.0, conditions)
    assert target.replies() == []


def test_an_emergency_stop_in_a_cycle_that_comes_too_early_counts_in_the_next_one(target):
    before = target.cycle(0.0, 0.0)
    send_too_early(target, Condition.ESTOP)
    reply = target.cycle(0.0, 0.0)
    assert (reply.action, reply.drive_enabled) == (SafetyAction.ESTOP, False)
    assert reply.refused > before.refused


def test_a_button_in_a_cycle_that_comes_too_early_has_no_effect(target):
    target.cycle(0.0, 0.0, Condition.ESTOP)
    for _ in range(50):
        target.cycle(0.0, 0.0)
    send_too_early(target, Condition.RESET)
    assert target.cycle(0.0, 0.0).action == SafetyAction.ESTOP
    assert target.cycle(0.0, 0.0, Condition.RESET).action < SafetyAction.ESTOP


# --- the host -----------------------------------------------------------------------------------------------------


class Host:
    """A controller at rest at home whose filter is on the target."""

    def __init__(self, target):
        self.target, self.ticks = target, 0
        self.controller = SafetyController(TargetFilter(UR5E, operating_config(UR5E), target.session))
        self.controller.safety.observe((), 0.0)

    def tick(self, conditions=0):
        """One tick after one period of the host's clock; the decisions of host and target."""
        self.ticks += 1
        now = self.ticks * PERIOD
        state = replace(home_state(UR5E), stamp=now, sequence=self.ticks)
        self.target.wait(self.target.period_us)
        self.controller.accept_state(state, now)
        decision = self.controller.decide(state, now, int(conditions))
        self.controller.control(state, np.zeros(UR5E.n), now)
        return decision, self.controller.safety.target.reply


@pytest.mark.parametrize(
    ("silence_ms", "check", "action"),
    [(60, "state_stale", SafetyAction.CONTROLLED_STOP), (200, "estop", SafetyAction.ESTOP)],
)
def test_the_host_stops_with_a_target_that_has_stopped_by_itself(target, silence_ms, check, action):
    """The clock of the host did not notice the silence; a person ends the stop on both."""
    host = Host(target)
    for _ in range(5):
        assert host.tick()[0].action < SafetyAction.HOVER
    for _ in range(silence_ms):
        target.wait(1000)
    _, reply = host.tick()
    assert reply.action == action
    decision, reply = host.tick()
    assert (decision.check, decision.action, reply.action) == (check, action, action)
    for button in (Condition.RESET, Condition.RESUME):
        for _ in range(500):  # longer than the release times
            decision, reply = host.tick()
        assert decision.action == reply.action
        host.tick(button)
    decision, reply = host.tick()
    assert decision.action == reply.action
    assert decision.action < SafetyAction.HOVER
    assert host.controller.safety.target.differences == 0


def reply_of_another_form(session):
    """An authenticated reply to the last CYCLE, shorter than those of this version."""
    return encode_frame(Message.CYCLE_REPLY, session._sequence, bytes(79), session._key)


def fail_to_read(session):
    raise OSError("no such device")


@pytest.mark.parametrize(
    ("read", "lost"), [(fail_to_read, "no such device"), (reply_of_another_form, r"79 bytes.*firmware of this version")]
)
def test_a_link_that_fails_or_a_reply_of_another_form_is_a_lost_target(target, monkeypatch, read, lost):
    host = Host(target)
    host.tick()
    monkeypatch.setattr(target, "read", lambda timeout: read(target.session))
    host.tick()
    assert re.search(lost, host.controller.safety.target.lost)
    assert host.tick()[0].check == "program_error"


def test_a_session_without_a_further_sequence_number_is_a_lost_target(target):
    host = Host(target)
    host.tick()
    target.session._sequence = 2**32 - 2
    assert host.tick()[1] is not None
    host.tick()
    assert "every sequence number" in host.controller.safety.target.lost
    assert host.tick()[0].check == "program_error"


def test_firmware_of_another_version_and_an_emulator_that_has_ended_are_lost_targets(target, monkeypatch):
    short = encode_frame(Message.HELLO_REPLY, 1, bytes(42), bytes(range(16)))
    monkeypatch.setattr(target, "read", lambda timeout: short)
    with pytest.raises(TargetLostError, match="firmware of this version"):
        target.open()
    (to_target, unread), (read, closed) = os.pipe()[::-1], os.pipe()
    os.close(closed)
    link = PipeLink(to_target, read)
    with pytest.raises(TargetLostError, match="the emulator has ended"):
        TargetSession(link, bytes(16), 0)
    link.close()
    os.close(unread)


def test_outputs_of_the_watchdog_are_kept_until_the_next_cycle_only(target):
    host = Host(target)
    host.tick()
    for _ in range(60):
        target.wait(1000)
    host.tick()
    assert len(target.session.outputs) > 3
    host.tick()
    assert target.session.outputs == []
