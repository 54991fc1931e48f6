"""The packet socket: packets arrive complete and in order, malformed ones are reported, and nothing blocks."""

import time
from dataclasses import fields

import numpy as np
import pytest

from dualbrain.control.gatekeeper.robot_link import packets
from dualbrain.control.gatekeeper.robot_link.packet_socket import MalformedPacket, PacketSocket, socket_pair
from dualbrain.robots.interface import RobotState

PACKETS = (packets.DrivePacket(on=True), packets.CommandPacket((0.1, -0.2), 0.04, 20.0), packets.ShutdownPacket())


@pytest.fixture
def ends():
    ours, theirs = socket_pair()
    here, there = PacketSocket(ours, packets.decode_from_robot), PacketSocket(theirs, packets.decode_to_robot)
    yield here, there
    here.close()
    there.close()


def test_packets_arrive_complete_and_in_order_and_receive_does_not_block(ends):
    here, there = ends
    assert there.receive() is None
    for packet in PACKETS:
        here.send(packet)
    assert there.wait(5.0)
    assert [there.receive() for _ in PACKETS] == list(PACKETS)
    assert there.receive() is None
    assert there.is_open


STATE = packets.StatePacket(stamp=0.0, sequence=1, q=(), v=(), opening=0.0, forces=(0.0, 0.0), drive_enabled=True)


@pytest.mark.parametrize(
    "data", [b"\xc1", b"garbage", packets.encode(packets.ShutdownPacket())[:1], packets.encode(STATE)]
)
def test_invalid_data_is_a_malformed_packet_and_the_link_stays_open(ends, data):
    here, there = ends
    here._socket.send(data)
    here.send(PACKETS[0])
    assert isinstance(there.receive(), MalformedPacket)
    assert there.receive() == PACKETS[0]


def test_a_packet_that_cannot_be_sent_at_once_is_lost(ends):
    here, there = ends
    for _ in range(100_000):
        here.send(PACKETS[1])
    n_received = 0
    while there.receive() is not None:
        n_received += 1
    assert 0 < n_received < 100_000
    assert here.is_open


def test_receive_detects_a_closed_end(ends):
    here, there = ends
    there.close()
    assert here.wait(5.0)
    assert here.receive() is None
    assert not here.is_open
    here.send(PACKETS[0])
    started = time.monotonic()
    assert not here.wait(0.05)
    assert time.monotonic() - started >= 0.05


def test_send_detects_a_closed_end(ends):
    here, there = ends
    here.close()
    there.send(packets.ShutdownPacket())
    assert not there.is_open


def test_a_joint_state_is_the_same_after_its_packet():
    state = RobotState(
        stamp=1.5,
        sequence=7,
        q=np.array([0.1, -0.2]),
        v=np.array([0.3, 0.4]),
        opening=None,
        finger_forces=(1.0, 2.0),
        drive_enabled=False,
    )
    received = packets.decode_from_robot(packets.encode(packets.StatePacket.from_state(state)))
    assert isinstance(received, packets.StatePacket)
    np.testing.assert_equal(vars_of(received.to_robot_state()), vars_of(state))


def vars_of(state):
    return {field.name: getattr(state, field.name) for field in fields(state)}
