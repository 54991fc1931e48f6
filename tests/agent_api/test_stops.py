"""A stop counts as confirmed only if the gatekeeper reports it after it was sent."""

import json
import time
from concurrent.futures import ThreadPoolExecutor
from threading import Event

import pytest
from starlette.applications import Starlette
from starlette.testclient import TestClient

from dualbrain.agent_api.retries import RETRY_WINDOW
from dualbrain.agent_server.console.routes import console_routes
from dualbrain.control.gatekeeper.protocol.client import ConnectionLostError
from dualbrain.errors import ConfigurationError
from dualbrain.runtime.planning import proposing
from tests.agent_api.stub_client import StubClient, open_robot


@pytest.fixture
def client(cell):
    found = StubClient(cell)
    found.motion = 9.0
    return found


@pytest.fixture
def robot(cell, client, monkeypatch):
    with open_robot(client, cell, monkeypatch) as opened:
        contract = opened.contract([{"skill": "hold", "params": {"duration": 9.0}}], "c-0001")
        assert opened.submit(contract).state == "running"
        yield opened
        client.end_motion()


def lose_scenes(client, monkeypatch):
    """From now on the gatekeeper answers nothing at all."""

    def lost(timeout=5.0):
        raise ConnectionLostError(f"no SceneReport within {timeout} s")

    monkeypatch.setattr(client, "request_scene", lost)


def test_a_confirmed_stop_returns_a_status_from_after_it(robot):
    sent_at = time.monotonic()
    status = robot.stop()
    assert (status.busy, status.now > sent_at) == (False, True)
    assert robot.call("stop")["sent"]


@pytest.mark.parametrize("answers_scenes", [True, False])
def test_a_stop_that_the_gatekeeper_does_not_report_is_an_error(answers_scenes, robot, client, monkeypatch):
    client.reports = False
    if not answers_scenes:
        lose_scenes(client, monkeypatch)
    started = time.monotonic()
    with pytest.raises(ConnectionLostError, match="did not confirm"):
        robot.stop()
    assert time.monotonic() - started < 3.0
    assert client.sent[0] == "abort"
    assert robot._executions._submissions["c-0001"].interrupted
    assert "emergency stop" in robot.call("stop")["error"]


def test_a_contract_that_goes_on_after_a_stop_is_an_error(robot, client, monkeypatch):
    monkeypatch.setattr(client, "operate", client.sent.append)
    with pytest.raises(ConnectionLostError, match="did not confirm"):
        robot.stop()


@pytest.mark.parametrize("words", ["stop", "Halt!", "stop it now, please"])
def test_an_instruction_to_stop_ends_the_running_contract_and_reports_it(words, robot, client):
    report = robot.do(words, timeout=5.0)
    assert client.sent[0] == "abort"
    assert (report.id, report.state, report.outcome.kind) == ("c-0001", "finished", "aborted")


def test_a_contract_after_the_connection_was_lost_is_rejected_and_its_id_is_free(cell, monkeypatch, tmp_path):
    client, path = StubClient(cell), tmp_path / "submissions.jsonl"
    with open_robot(client, cell, monkeypatch, retries=path) as opened:
        contract = opened.contract([{"skill": "hold", "params": {"duration": 0.5}}], "c-0001")
        with monkeypatch.context() as patch:
            lose_scenes(client, patch)
            report = opened.run(contract, timeout=5.0)
        assert (report.state, report.outcome, client.executed) == ("rejected", None, [])
        assert "no SceneReport" in str(report.rejected.got)
        assert "nothing was sent" in report.rejected.hint
        again = opened.run(contract, timeout=5.0)
        assert (again.state, again.repeated, client.executed) == ("finished", False, ["c-0001"])
    ends = [line["report"] for line in map(json.loads, path.read_text().splitlines()) if line["report"]]
    assert [end["state"] for end in ends] == ["rejected", "finished"]


def test_an_instruction_to_stop_ends_a_contract_whose_submission_is_lost(robot, client):
    robot._executions._submissions["c-0001"].lose("a mistake in the program")
    with pytest.raises(ConfigurationError, match="no planner"):
        robot.do("stop")
    assert client.sent == ["abort"]
    assert not client.status.busy


def test_a_jump_of_the_system_time_releases_no_id(robot, client, monkeypatch):
    again = robot.contract([{"skill": "hold", "params": {"duration": 9.0}}], "c-0001")
    present = time.time()
    monkeypatch.setattr(time, "time", lambda: present + 2.0 * RETRY_WINDOW)
    assert robot.submit(again).repeated
    client.end_motion()
    assert robot.outcome("c-0001", timeout=5.0).state == "finished"
    assert robot.submit(again).repeated


def test_the_console_shows_a_stop_that_is_not_confirmed_as_an_error(robot, client, tmp_path):
    client.reports = False
    app = Starlette(routes=console_routes(robot, runs=tmp_path, ledger=None))
    with TestClient(app) as console:
        reply = console.post("/console/api/stop", content=b'{"emergency": false}')
    assert reply.status_code == 503
    assert "did not confirm" in reply.json()["error"]


def test_an_emergency_stop_that_only_its_own_connection_reports_has_no_status(robot, client):
    client.reports = False
    assert robot.stop(emergency=True) is None
    assert robot.call("stop", {"emergency": True}) == {"sent": True, "action": "", "reason": ""}


def test_a_scene_that_comes_too_late_ends_no_contract(robot, client, monkeypatch):
    with monkeypatch.context() as patched:
        lose_scenes(client, patched)
        assert robot.outcome("c-0001", timeout=0.3).state == "running"
    assert client.status.busy
    robot.stop()
    report = robot.outcome("c-0001", timeout=5.0)
    assert (report.state, report.outcome.kind) == ("finished", "aborted")


def test_a_contract_on_its_way_to_the_gate_does_not_begin_after_a_stop(robot, client, monkeypatch):
    """The stop is confirmed, because nothing moves yet; the contract must not move the robot afterwards."""
    robot.stop()
    robot.outcome(timeout=5.0)
    under_way, stopped = Event(), Event()
    check = proposing.reject_before_gate

    def check_slowly(*parts):
        under_way.set()
        stopped.wait(5.0)
        return check(*parts)

    monkeypatch.setattr(proposing, "reject_before_gate", check_slowly)
    contract = robot.contract([{"skill": "hold", "params": {"duration": 9.0}}], "c-0002")
    with ThreadPoolExecutor(1) as pool:
        running = pool.submit(robot.run, contract)
        assert under_way.wait(5.0)
        assert not robot.stop().busy
        stopped.set()
        report = running.result(5.0)
    assert (report.state, report.outcome.kind, report.accepted) == ("finished", "aborted", False)
    assert client.executed == ["c-0001"]
