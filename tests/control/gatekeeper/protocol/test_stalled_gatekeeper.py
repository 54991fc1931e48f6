"""A gatekeeper that stops reading delays no client for longer than the limit: the connection counts as lost."""

from concurrent.futures import ThreadPoolExecutor
from threading import Event

import pytest

from dualbrain.control.gatekeeper.protocol import client as client_module
from dualbrain.control.gatekeeper.protocol.authentication import load_keys
from dualbrain.control.gatekeeper.protocol.client import ConnectionLostError, GatekeeperClient
from dualbrain.control.gatekeeper.protocol.messages import CheckRequest
from tests.control.gatekeeper.protocol.test_matched_replies import ScriptedGatekeeper

LIMIT = 0.3


class StalledGatekeeper(ScriptedGatekeeper):
    """Reads until `stall` is set, and then nothing until `resume` is."""

    def __init__(self, path):
        self.stall, self.resume = Event(), Event()
        super().__init__(path, [])

    def _receive(self):
        if self.stall.is_set():
            self.resume.wait(30.0)
        return super()._receive()


def send_until_the_buffers_are_full(client):
    for _ in range(100):
        client.send(CheckRequest(contract=b"x" * 50_000))


def test_a_send_to_a_gatekeeper_that_reads_nothing_ends_within_the_limit(tmp_path, monkeypatch):
    monkeypatch.setattr(client_module, "SEND_TIMEOUT", LIMIT)
    gatekeeper = StalledGatekeeper(tmp_path / "s")
    client = GatekeeperClient(tmp_path / "s", load_keys(tmp_path / "keys", ("planner",)), "planner")
    gatekeeper.stall.set()
    with ThreadPoolExecutor(1) as threads:
        sending = threads.submit(send_until_the_buffers_are_full, client)
        try:
            error = sending.exception(timeout=20.0 * LIMIT)
        finally:
            gatekeeper.resume.set()  # ends a send without a limit, so that a failure does not block
    assert isinstance(error, ConnectionLostError)
    assert "has read nothing" in str(error)
    assert client.disconnected.wait(1.0)
    with pytest.raises(ConnectionLostError):
        client.operate("pause")
    client.close()
    gatekeeper.close()
