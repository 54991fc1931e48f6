"""A robot for agents: checks without effects, contracts and instructions with outcomes, repetition, and stops."""

import json
import os
import signal
import time

import jsonschema_rs
import pytest

from dualbrain import Robot
from dualbrain.agent_api import saved_runs
from dualbrain.agent_api.tools import report_view
from dualbrain.contracts.verdict import Accepted
from dualbrain.control.gatekeeper.config import GatekeeperConfig
from dualbrain.control.gatekeeper.process import GatekeeperProcess
from dualbrain.control.gatekeeper.protocol.client import ConnectionLostError
from dualbrain.errors import ConfigurationError
from dualbrain.memory.embedding.hashing_encoder import HashingEncoder
from dualbrain.memory.embedding.text_encoder import MiniLmEncoder
from dualbrain.memory.ledger.ledger import LedgerReader
from dualbrain.memory.state.derivation import derive_state
from dualbrain.memory.state.episode_record import decode_event_header, decode_stored_episode
from dualbrain.planner.scripted import ScriptedPlanner
from dualbrain.simulation.scenes.generators.catalogue import open_scene
from dualbrain.visualization.html import run_report
from tests.agent_api.test_saved_runs import full_disk
from tests.stories.story_session import GRASP, PLACE

pytestmark = pytest.mark.realtime


def hold(robot, seconds, contract_id=""):
    return robot.contract([{"skill": "hold", "params": {"duration": seconds}}], contract_id)


@pytest.fixture
def home(tmp_path, monkeypatch):
    monkeypatch.setenv("DUALBRAIN_HOME", str(tmp_path / "home"))
    monkeypatch.setattr(MiniLmEncoder, "from_cache", classmethod(lambda cls, cache: HashingEncoder()))
    return tmp_path


def test_contracts_are_checked_executed_once_and_remembered_under_their_client(home, monkeypatch):
    ledger, runs = home / "ledger.sqlite", home / "runs"
    planner = ScriptedPlanner(["no contract"])
    with Robot.simulated("panda", scene="bare:0", ledger=ledger, runs=runs, planner=planner) as robot:
        check_checks(robot)
        check_schemas(robot)
        first = robot.run(hold(robot, 0.5, "c-0001"), "pause briefly", client="desk agent")
        assert (first.state, first.accepted, first.succeeded) == ("finished", True, True)
        again = robot.run(hold(robot, 0.5, "c-0001"))
        assert (again.repeated, again.episode) == (True, first.episode)
        assert robot.run(hold(robot, 0.6, "c-0001")).rejected.pointer == "/id"
        assert robot.contract([])["id"] == "c-0002"
        refused = robot.run(hold(robot, 0.5, "c-0002"), "stop")
        assert refused.rejected.hint == "stop the robot instead of submitting a contract"
        other = robot.run(hold(robot, 0.5, "c-0002"), client="other agent")
        planned = robot.do("put the red cube in the bowl", timeout=20.0)
        assert (planned.state, planned.accepted) == ("rejected", False)
        assert planned.rejected.stage == "syntax"
        assert [one["state"] for one in robot.recent()][:2] == ["rejected", "finished"]
        assert robot.call("get_outcome", {"id": "c-0001"})["outcome"]["succeeded"]
        check_late_verdict(robot, monkeypatch)
        check_unsaved_episode(robot, monkeypatch)
        check_failed_report(robot, monkeypatch)
    check_memory(ledger, runs, first, other)


def check_late_verdict(robot, monkeypatch):
    """A contract whose verdict comes late moves the robot all the same, so `run` waits for its outcome."""
    with monkeypatch.context() as patch:
        patch.setattr("dualbrain.agent_api.executions.VERDICT_TIMEOUT", 0.0)
        assert robot.run(hold(robot, 0.5, "c-0009"), client="desk agent").state == "finished"


def check_schemas(robot):
    """The hand is empty, and the cube is 40 mm wide: a narrow grasp and a placement are refused now, not for ever."""
    narrow = robot.contract([{"skill": "grasp", "params": GRASP | {"opening": 0.03}}])
    place = robot.contract([{"skill": "place", "params": PLACE}])
    for contract in (narrow, place):
        assert not jsonschema_rs.validator_for(robot.schema()).is_valid(contract)
        assert jsonschema_rs.validator_for(robot.schema("tool")).is_valid(contract)
    (tool,) = (one for one in robot.tools("mcp") if one["name"] == "submit_contract")
    assert tool["inputSchema"]["properties"]["contract"] == robot.schema("tool")
    with pytest.raises(ConfigurationError, match="form of the schema"):
        robot.schema("short")


def check_checks(robot):
    """A check has the verdict of the gate, and nothing moves."""
    before = robot._scene_report().q
    assert isinstance(robot.check(hold(robot, 0.5)), Accepted)
    assert robot.check(hold(robot, 500.0)).stage == "envelope"
    assert robot.check(b"\xff").stage == "syntax"
    assert robot.check(b"x" * 70_000).allowed == "at most 65536 bytes"
    assert robot.submit(b"x" * 70_000).state == "rejected"
    assert robot.submit(b"no json").rejected.stage == "syntax"
    assert robot._scene_report().q == pytest.approx(before, abs=1e-3)


def check_failed_report(robot, monkeypatch):
    """A report that cannot be written changes no outcome, and is an event."""
    monkeypatch.setattr(run_report, "write_report", lambda *parts: {}["missing"])
    assert robot.run(hold(robot, 500.0, "c-0003")).rejected.stage == "envelope"
    event = robot.events()[-1]
    assert event["kind"] == "recorder"
    assert event["text"].startswith("No report of the run ")


def check_unsaved_episode(robot, monkeypatch):
    """An episode that cannot be saved leaves the outcome true, with a warning, and is an event."""
    with monkeypatch.context() as patch:
        patch.setattr(saved_runs, "write_atomically", full_disk)
        rejected = robot.run(hold(robot, 500.0, "c-0004"))
    assert (rejected.state, rejected.rejected.stage) == ("rejected", "envelope")
    assert "is not saved" in rejected.warning
    assert report_view(rejected)["warning"] == rejected.warning
    assert robot.events()[-1]["text"] == rejected.warning


def check_memory(ledger, runs, first, other):
    """The ledger holds every episode that reached the gate, and each one is saved in its folder.

    A success that the senses do not confirm is a candidate.
    """
    with LedgerReader(ledger) as reader:
        events = list(reader.events("episode"))
        headers = [decode_event_header(event.payload) for event in events]
        episodes = [decode_stored_episode(event.payload).episode for event in events]
        statuses = {memory.id: memory.status for memory in derive_state(reader).memories}
    sources = {episode.id: header.provenance.source for episode, header in zip(episodes, headers, strict=True)}
    assert (sources[first.episode], first.senses, statuses[first.episode]) == ("desk agent", "agrees", "active")
    assert (sources[other.episode], other.senses, statuses[other.episode]) == ("other agent", "none", "candidate")
    versions = json.loads((runs / first.episode / "episode.json").read_bytes())["versions"]
    assert {"dualbrain", "kernel", "prompt", "beside"} <= versions.keys()
    assert sorted(sources) == sorted(folder.name for folder in runs.iterdir())
    assert sum(not (folder / "episode.json").is_file() for folder in runs.iterdir()) == 1
    assert sum(not (folder / "report.html").is_file() for folder in runs.iterdir()) == 2
    report = (runs / first.episode / "report.html").read_text()
    assert "pause briefly" in report
    assert "accepted" in report
    assert first.outcome.actions[0].reason in report


def test_a_running_contract_excludes_others_and_can_be_checked_against_and_stopped(home):
    with Robot.simulated("panda", scene="bare:0") as robot:
        running = robot.submit(hold(robot, 9.0, "c-0001"))
        assert running.state == "running"
        assert isinstance(robot.check(hold(robot, 0.5, "c-0002")), Accepted)
        busy = robot.submit(hold(robot, 0.5, "c-0002"))
        assert (busy.state, busy.rejected.got) == ("rejected", "c-0001 is in progress")
        assert robot.submit(hold(robot, 9.0, "c-0001")).repeated
        assert robot.outcome("c-0009") is None
        started = time.monotonic()
        assert robot.stop().action in ("HOLD", "NONE")
        ended = robot.outcome(timeout=5.0)
        assert (ended.state, ended.outcome.kind) == ("finished", "aborted")
        assert time.monotonic() - started < 2.0
        with pytest.raises(ConfigurationError, match="planner"):
            robot.do("go home")
        assert robot.stop(emergency=True).action == "ESTOP"
        after = robot.run(hold(robot, 0.5, "c-0003"), timeout=5.0)
        assert not after.succeeded
        kinds = {event["kind"] for event in robot.events()}
        assert {"verdict", "action", "operator"} <= kinds
        assert next(event["number"] for event in robot.events(after=2)) == 3


@pytest.mark.slow
def test_a_gatekeeper_that_ends_during_a_contract_is_a_lost_submission(home):
    with Robot.simulated("panda", scene="bare:0") as robot:
        robot.submit(hold(robot, 9.0, "c-0001"))
        os.kill(robot.gatekeeper_process_id, signal.SIGKILL)
        ended = robot.outcome(timeout=10.0)
        assert ended.outcome.kind == "stopped"
        with pytest.raises(ConnectionLostError):
            robot.check(hold(robot, 0.5))
        assert "cannot be reached" in robot.call("get_scene")["error"]
        unsent = robot.run(hold(robot, 0.5, "c-0002"))
        assert (unsent.state, unsent.accepted) == ("rejected", False), "it was not sent, so its outcome is known"


def test_a_running_gatekeeper_has_one_commander_and_a_retry_after_a_restart_moves_nothing(home):
    socket, keys = home / "s", home / "keys"
    config = GatekeeperConfig(robot="panda", scene=open_scene("bare:0"), socket=str(socket), keys=str(keys))
    gatekeeper = GatekeeperProcess(config)
    try:
        with Robot.connect(socket, keys) as robot:
            contract = hold(robot, 0.5, "c-0001")
            assert robot.gatekeeper_process_id == 0
            assert robot.run(contract).succeeded
            with pytest.raises(ConnectionLostError, match="commander already"):
                Robot.connect(socket, keys)
        with Robot.connect(socket, keys) as robot:
            again = robot.run(contract)
            assert (again.repeated, again.succeeded) == (True, True)
            assert not robot.events()
            assert robot.contract([])["id"] == "c-0002"
        with pytest.raises(ConfigurationError, match="other skills or bounds"):
            Robot.connect(socket, keys, robot="ur5e")
    finally:
        gatekeeper.stop()
