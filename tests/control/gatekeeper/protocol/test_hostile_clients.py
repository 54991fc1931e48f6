"""Messages of clients that no honest program sends: the gatekeeper ticks on, and every stop condition is reported."""

import socket

import pytest

from dualbrain.control.gatekeeper.gatekeeper import HEARTBEAT_TIMEOUT
from dualbrain.control.gatekeeper.protocol.authentication import hello_proof
from dualbrain.control.gatekeeper.protocol.frames import FrameDecoder, encode
from dualbrain.control.gatekeeper.protocol.messages import (
    Hello,
    Propose,
    decode_message,
    encode_body,
    kind_code,
)
from dualbrain.safety.supervisor.conditions import Condition
from tests.control.gatekeeper.lockstep_cell import make_cell

LOST = Condition.LINK_LOST | Condition.HEARTBEAT_LOST


class Ticks:
    """A gatekeeper whose connections are served tick by tick, at a time that a test sets."""

    def __init__(self, folder):
        self.cell, self.now = make_cell(folder), 100.0
        self.gatekeeper = self.cell.gatekeeper
        self.gatekeeper._monotonic = lambda: self.now

    def tick(self):
        """The conditions of one tick."""
        return self.gatekeeper._service_connections()

    def connect(self):
        return Client(self)

    def authenticate(self, client):
        """Give `client` the role of the commander; the conditions of this tick."""
        proof = hello_proof(self.cell.keys.secrets["planner"], client.nonce, "planner")
        client.send(Hello(principal="planner", proof=proof))
        return self.tick()

    def commander(self):
        client = self.connect()
        self.authenticate(client)
        return client


class Client:
    """A raw connection of a client that has received its challenge."""

    def __init__(self, ticks):
        self._socket, self._sent = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM), 0
        self._socket.connect(str(ticks.cell.socket))
        ticks.tick()
        decoder = FrameDecoder()
        decoder.feed(self._socket.recv(4096))
        self.nonce = decode_message(decoder.next_frame(), from_client=False).nonce

    def send(self, message):
        self._sent += 1
        self._socket.sendall(encode(kind_code(message), self._sent, encode_body(message)))

    def close(self):
        self._socket.close()


@pytest.fixture
def ticks(tmp_path):
    made = Ticks(tmp_path)
    yield made
    made.cell.server.close()


@pytest.mark.parametrize("scene_version", [-1, 2**63, 2**64 - 1])
def test_a_contract_with_an_impossible_scene_version_closes_its_connection_only(ticks, scene_version):
    commander = ticks.commander()
    other = ticks.connect()
    commander.send(Propose(contract=b"{}", issued=0.0, expires=1.0, scene_version=scene_version, mac=b"m" * 32))
    assert ticks.tick() & Condition.FRAMES_REFUSED
    assert len(ticks.cell.server.connections) == 1
    assert ticks.tick() & Condition.LINK_LOST
    commander.close()
    other.close()


def test_the_replacement_of_a_silent_commander_is_a_lost_connection(ticks):
    """Also in the tick in which the former commander becomes silent: its contract must end."""
    first, second = ticks.commander(), ticks.connect()
    ticks.now += HEARTBEAT_TIMEOUT
    assert not ticks.tick() & LOST
    ticks.now += 1e-3
    assert ticks.authenticate(second) & Condition.LINK_LOST
    assert not ticks.tick() & LOST
    assert ticks.gatekeeper._commander.number == 2
    first.close()
    second.close()
