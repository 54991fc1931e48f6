"""The wire: packets come whole and in order, rubbish is named, nothing waits, and a dead end is noticed."""

import time

import pytest

from dualbrain.control.gatekeeper.robot_link import packets
from dualbrain.control.gatekeeper.robot_link.packet_socket import MalformedPacket, PacketSocket, socket_pair

WORDS = (packets.DrivePacket(on=True), packets.CommandPacket((0.1, -0.2), 0.04, 20.0), packets.ShutdownPacket())


@pytest.fixture
def ends():
    ours, theirs = socket_pair()
    here, there = PacketSocket(ours, packets.decode_from_robot), PacketSocket(theirs, packets.decode_to_robot)
    yield here, there
    here.close()
    there.close()


def test_packets_come_whole_and_in_order_and_nobody_waits(ends):
    here, there = ends
    assert there.hear() is None
    for word in WORDS:
        here.send(word)
    assert there.wait(5.0)
    assert [there.hear() for _ in WORDS] == list(WORDS)
    assert there.hear() is None
    assert there.open


STATE = packets.StatePacket(0.0, 1, (), (), 0.0, (0.0, 0.0), drive_enabled=True)


@pytest.mark.parametrize(
    "data", [b"\xc1", b"rubbish", packets.encode(packets.ShutdownPacket())[:1], packets.encode(STATE)]
)
def test_what_is_no_packet_of_this_direction_is_rubbish_and_the_wire_stays_open(ends, data):
    here, there = ends
    here._link.send(data)
    here.send(WORDS[0])
    assert isinstance(there.hear(), MalformedPacket)
    assert there.hear() == WORDS[0]


def test_a_packet_that_does_not_go_at_once_is_lost(ends):
    here, there = ends
    for _ in range(100_000):
        here.send(WORDS[1])
    heard = 0
    while there.hear() is not None:
        heard += 1
    assert 0 < heard < 100_000
    assert here.open


def test_a_dead_end_is_noticed_by_hearing_and_by_sending(ends):
    here, there = ends
    there.close()
    assert here.wait(5.0)
    assert here.hear() is None
    assert not here.open
    here.send(WORDS[0])
    began = time.monotonic()
    assert not here.wait(0.05)
    assert time.monotonic() - began >= 0.05


def test_sending_into_a_dead_end_closes_it(ends):
    here, there = ends
    here.close()
    there.send(packets.ShutdownPacket())
    assert not there.open
