"""The client's estimate of the gatekeeper's time follows a clock that drifts or loses time."""

import socket
import time
from threading import Thread

import pytest

from dualbrain.control.gatekeeper.protocol.client import CLOCK_ALLOWANCE, CLOCK_REPORTS, GatekeeperClient
from dualbrain.control.gatekeeper.protocol.frames import encode
from dualbrain.control.gatekeeper.protocol.messages import Challenge, StatusReport, Welcome, encode_body, kind_code

GAP = 0.25
"""Time [s] that the gatekeeper's clock loses after the welcome."""


def report(now):
    return StatusReport(now=now, action="NONE", cause="", check="", busy=False)


class OneClientGatekeeper:
    """Accepts one observer and sends the messages that it is given."""

    def __init__(self, path):
        self._listener = socket.socket(socket.AF_UNIX)
        self._listener.bind(str(path))
        self._listener.listen(1)
        self._sent = 0
        Thread(target=self._welcome, daemon=True).start()

    def _welcome(self):
        self._connection, _ = self._listener.accept()
        self.send(Challenge(b"n" * 16))
        self._connection.recv(4096)
        self.send(Welcome(role="observer", now=time.monotonic(), robot="panda", registry=""))

    def send(self, message):
        self._sent += 1
        self._connection.sendall(encode(kind_code(message), self._sent, encode_body(message)))

    def close(self):
        self._connection.close()
        self._listener.close()


@pytest.fixture
def ends(tmp_path):
    gatekeeper = OneClientGatekeeper(tmp_path / "s")
    client = GatekeeperClient(tmp_path / "s")
    yield gatekeeper, client
    client.close()
    gatekeeper.close()


def wait_for(condition):
    deadline = time.monotonic() + 5.0
    while not condition() and time.monotonic() < deadline:
        time.sleep(0.002)
    assert condition()


def test_a_clock_that_loses_time_is_followed(ends):
    gatekeeper, client = ends
    assert -0.5 < client.now - time.monotonic() <= -CLOCK_ALLOWANCE
    gatekeeper.send(report(time.monotonic() - GAP))
    wait_for(lambda: client.status is not None and client.now <= time.monotonic() - GAP - CLOCK_ALLOWANCE)


def test_a_clock_that_gains_time_is_followed_after_a_second(ends):
    gatekeeper, client = ends
    for _ in range(CLOCK_REPORTS):
        gatekeeper.send(report(time.monotonic() + GAP))
    wait_for(lambda: client.now > time.monotonic() + 0.5 * GAP)
    assert client.now <= time.monotonic() + GAP
