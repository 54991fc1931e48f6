"""The packets between a control thread in C and the process of the robot: equal bits, and nothing else is accepted."""

import socket
import struct

import msgspec
import numpy as np
import pytest

from dualbrain.control.gatekeeper.robot_link.control_link import (
    COMMAND_PACKET,
    ControlLink,
    ThreadCommand,
    decode_command,
    encode_state,
)
from dualbrain.control.gatekeeper.robot_link.packet_socket import MalformedPacket, socket_pair
from dualbrain.robots.interface import Command, RobotState
from dualbrain.robots.loader import load_robot
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.safety.control_thread import ControlThread
from dualbrain.safety.supervisor.actions import SafetyAction
from dualbrain.safety.supervisor.conditions import Condition

HOME = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.8])


@pytest.fixture
def arm():
    return msgspec.structs.replace(load_robot("panda"), force_sensing=None)


def state(sequence, **changes):
    values = {"q": HOME + 1e-3 / 3.0, "v": np.full(7, 1e-4 / 7.0), "opening": 0.0123, "finger_forces": (0.0, 0.0)}
    return RobotState(**{"stamp": 1.0 + 0.001 * sequence, "sequence": sequence} | values | changes)


class Bench:
    """A control thread that a test ticks, and the robot's end of its link."""

    def __init__(self, robot_model):
        ours, theirs = socket_pair()
        ours.setblocking(False)
        self.thread = ControlThread(SafetyFilter(robot_model), link=ours)
        self.ours, self.theirs = ours, theirs
        self.link = ControlLink(theirs)
        self.now = 0.0

    def tick(self):
        self.now += 0.001
        self.thread.tick(self.now)
        return self.thread.read_log()[-1]

    def close(self):
        self.thread.stop()
        self.ours.close()
        self.theirs.close()


@pytest.fixture
def bench(arm):
    made = Bench(arm)
    yield made
    made.close()


def test_a_state_arrives_with_equal_bits(bench):
    sent = state(1, desired_v=np.full(7, 0.1 / 3.0), desired_a=np.full(7, -0.2 / 7.0), drive_enabled=False)
    bench.link.send_state(sent)
    record = bench.tick()
    assert record["new_state"]
    assert (int(record["state_sequence"]), int(record["state_stamp_us"])) == (1, 1_001_000)
    assert (record["state_opening"], bool(record["state_drive_enabled"])) == (0.0123, False)
    for name, values in (("q", sent.q), ("v", sent.v), ("desired_v", sent.desired_v), ("desired_a", sent.desired_a)):
        assert np.array_equal(record[f"state_{name}"][:7], values)


def test_an_unknown_opening_and_a_missing_desired_motion_stay_unknown(bench):
    bench.link.send_state(state(1, opening=None))
    record = bench.tick()
    assert np.isnan(record["state_opening"])
    assert not record["state_has_desired"]


def test_the_newest_of_several_states_counts(bench):
    for sequence in range(1, 6):
        bench.link.send_state(state(sequence))
    assert int(bench.tick()["state_sequence"]) == 5
    assert not bench.tick()["new_state"]


def test_a_command_arrives_with_equal_bits_and_the_drive(bench):
    for sequence in range(1, 4):
        bench.link.send_state(state(sequence))
        bench.thread.submit_control(np.full(7, 0.05))
        record = bench.tick()
        command = bench.link.receive().command
        assert command.tick == int(record["tick"])
        assert np.array_equal(command.u, record["u"][:7])
        assert command.drive == record["drive_enable"]
    assert command.u.any()


VALID = encode_state(state(1))


@pytest.mark.parametrize(
    "packet",
    [b"", b"x", VALID[:-1], VALID + b"\0", VALID[:4] + b"\x06\0\0\0" + VALID[8:], b"\xff" * len(VALID), b"\0" * 4096],
    ids=["empty", "short", "cut", "longer", "other joints", "ones", "oversized"],
)
def test_a_packet_of_another_form_is_dropped_and_counted(bench, packet):
    bench.link.send_state(state(1))
    bench.tick()
    bench.theirs.send(packet) if packet else None
    assert not bench.tick()["new_state"]
    assert bench.thread.status().malformed == bool(packet)


def test_values_that_are_not_finite_arrive_and_stop_the_arm(bench):
    bench.link.send_state(state(1))
    bench.tick()
    bench.link.send_state(state(2, desired_v=np.full(7, np.nan), desired_a=np.zeros(7)))
    record = bench.tick()
    assert not record["state_used"]
    assert int(record["conditions"]) & int(Condition.STATE_IMPLAUSIBLE)


@pytest.mark.parametrize("data", [b"", b"\0" * 24, b"\xff" * 80, b"DBC1" + b"\x07\0\0\0" + b"\0" * 16])
def test_bytes_that_are_no_command_are_malformed(data):
    with pytest.raises(msgspec.DecodeError):
        decode_command(data)


def test_a_malformed_command_is_reported_as_one():
    ours, theirs = socket_pair()
    link = ControlLink(theirs)
    ours.send(b"no command")
    assert isinstance(link.receive(), MalformedPacket)
    ours.close()
    theirs.close()


def test_no_command_is_complete_before_the_gripper_has_one():
    ours, theirs = socket_pair()
    link, command = ControlLink(theirs), ThreadCommand(1, True, np.full(7, 0.1))
    assert link.complete(command) is None
    link.set_gripper(Command(np.full(7, 9.0), 0.04, 12.0))
    whole = link.complete(command)
    assert (whole.opening, whole.force) == (0.04, 12.0)
    assert np.array_equal(whole.u, command.u)
    ours.close()
    theirs.close()


def command_packet(tick, *, drive, speed=0.0):
    head = struct.pack("=IIQII", COMMAND_PACKET, 7, tick, drive, 0)
    return head + np.full(7, speed).tobytes()


@pytest.mark.parametrize(
    ("drives", "switched"),
    [((False,), None), ((True,), True), ((True, True), True), ((True, False), False), ((True, False, True), True)],
)
def test_of_several_commands_the_newest_counts_and_every_change_of_the_drive(drives, switched):
    ours, theirs = socket_pair()
    link = ControlLink(theirs)
    for tick, drive in enumerate(drives):
        ours.send(command_packet(tick, drive=drive, speed=0.1 * tick))
    received = link.receive()
    assert received.switched is switched
    assert received.command.tick == len(drives) - 1
    assert received.command.u[0] == 0.1 * (len(drives) - 1)
    assert link.receive() is None
    ours.close()
    theirs.close()


def test_a_robot_that_repeats_its_last_state_is_stopped(bench):
    for sequence in range(1, 20):
        bench.link.send_state(state(sequence))
        bench.thread.submit_control(np.full(7, 0.05))
        bench.tick()
    actions = []
    for _ in range(200):
        bench.link.send_state(state(19))  # alive, and without a new measurement
        bench.thread.submit_control(np.full(7, 0.05))
        actions.append(int(bench.tick()["action"]))
    assert actions.index(SafetyAction.CONTROLLED_STOP) <= 55
    assert actions[-1] == SafetyAction.ESTOP


def test_a_closed_link_ends_in_an_emergency_stop(bench):
    bench.link.send_state(state(1))
    bench.tick()
    bench.theirs.shutdown(socket.SHUT_RDWR)
    bench.thread.start()
    bench.thread.stop()
    records = bench.thread.read_log()
    assert not records["drive_enable"][-1]
    assert bench.thread.status().unsent > 0
