"""A gatekeeper that stops reading delays no client for longer than the limit: the connection counts as lost."""

import time
from concurrent.futures import ThreadPoolExecutor
from threading import Event, Thread

import pytest

from dualbrain.contracts.contract import Action, Context, Contract
from dualbrain.control.gatekeeper import remote_executor
from dualbrain.control.gatekeeper.protocol import client as client_module
from dualbrain.control.gatekeeper.protocol.authentication import load_keys
from dualbrain.control.gatekeeper.protocol.client import ConnectionLostError, GatekeeperClient
from dualbrain.control.gatekeeper.protocol.messages import CheckRequest, OutcomeReport, StatusReport
from dualbrain.control.gatekeeper.remote_executor import RemoteExecutor
from dualbrain.control.recording.flight_log import FlightLog
from dualbrain.control.recording.trace import Trace
from dualbrain.records import Outcome
from dualbrain.robots.loader import load_robot
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


# --- a gatekeeper that sends nothing ----------------------------------------------------------------------------------

CONTRACT = Contract("c-0001", Context("panda", ""), (Action("hold", {"duration": 9.0}),))
PANDA = load_robot("panda")


@pytest.fixture
def waiting(tmp_path, monkeypatch):
    """A gatekeeper that answers no scene request any more, and an executor that is to wait for its outcome."""
    monkeypatch.setattr(remote_executor, "SILENCE_LIMIT", LIMIT)
    gatekeeper = ScriptedGatekeeper(tmp_path / "s", [])
    client = GatekeeperClient(tmp_path / "s", load_keys(tmp_path / "keys", ("planner",)), "planner")
    executor = RemoteExecutor(PANDA, client, FlightLog(Trace(PANDA.n), None), lambda: False)
    gatekeeper.holds_scenes = True
    yield gatekeeper, executor
    client.close()
    gatekeeper.close()


def test_a_gatekeeper_that_sends_nothing_ends_the_wait_for_the_outcome_within_the_limit(waiting):
    _, executor = waiting
    started = time.monotonic()
    outcome = executor.execute(CONTRACT)
    assert LIMIT <= time.monotonic() - started + 0.1 < 20.0 * LIMIT
    assert (outcome.kind, outcome.reason) == (
        "stopped",
        f"the connection to the gatekeeper was lost: the gatekeeper has not answered for {LIMIT:g} s",
    )
    assert executor.client.disconnected.is_set()


def test_a_gatekeeper_that_sends_its_status_but_no_scene_ends_no_contract(waiting, monkeypatch):
    monkeypatch.setattr(remote_executor, "SILENCE_LIMIT", 4.0 * LIMIT)  # longer than a pause of this thread
    gatekeeper, executor = waiting

    def report():
        for _ in range(round(8.0 * LIMIT / 0.05)):
            time.sleep(0.05)
            gatekeeper.send(
                StatusReport(now=time.monotonic(), action="NONE", cause="", check="", busy=True, commander=True)
            )
        gatekeeper.holds_scenes = False
        gatekeeper.send(OutcomeReport(Outcome(kind="succeeded", reason="at its end"), {}))

    reporting = Thread(target=report)
    reporting.start()
    outcome = executor.execute(CONTRACT)
    reporting.join()
    assert (outcome.kind, outcome.reason) == ("succeeded", "at its end")
