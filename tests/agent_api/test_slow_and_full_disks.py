"""A disk that is slow or full delays no stop, blocks no later contract, and hides no outcome."""

import errno
import os
import threading
import time
from contextlib import contextmanager

import pytest

from dualbrain.agent_api.retries import RetryLog
from dualbrain.agent_api.tools import report_view
from dualbrain.core.storage import jsonl_log
from dualbrain.runtime.agent import NoMemory
from tests.agent_api.stub_client import StubClient, open_robot


@pytest.fixture
def client(cell):
    return StubClient(cell)


@pytest.fixture
def robot(cell, client, tmp_path, monkeypatch):
    with open_robot(client, cell, monkeypatch, retries=tmp_path / "submissions.jsonl") as opened:
        yield opened


def hold(robot, contract_id):
    return robot.contract([{"skill": "hold", "params": {"duration": 9.0}}], contract_id)


class StalledDisk:
    """A disk on which every write waits for `release`; `begun` is set when one waits."""

    def __init__(self):
        self.begun, self.release = threading.Event(), threading.Event()

    def sync(self, descriptor):
        self.begun.set()
        assert self.release.wait(30.0)


def refuse_to_sync(descriptor):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


@contextmanager
def stalled_submission(robot, monkeypatch):
    """A contract whose line is being written until the end of the block."""
    disk = StalledDisk()
    monkeypatch.setattr(jsonl_log.os, "fsync", disk.sync)
    submitting = threading.Thread(target=robot.submit, args=(hold(robot, "c-0001"),))
    submitting.start()
    try:
        assert disk.begun.wait(10.0)
        yield
    finally:
        disk.release.set()
        submitting.join()


@pytest.mark.parametrize("emergency", [True, False])
def test_a_stop_waits_for_no_write_before_the_motion(emergency, robot, client, monkeypatch):
    with stalled_submission(robot, monkeypatch):
        check_stop_and_reports(robot, client, emergency=emergency)
    assert robot.outcome(timeout=10.0).outcome.kind == "aborted"
    assert client.executed == []


def test_a_stop_waits_for_no_write_after_the_motion(robot, client, monkeypatch):
    disk = StalledDisk()
    robot.submit(hold(robot, "c-0001"))
    monkeypatch.setattr(jsonl_log.os, "fsync", disk.sync)
    try:
        assert disk.begun.wait(10.0)
        check_stop_and_reports(robot, client, emergency=True)
    finally:
        disk.release.set()


def check_stop_and_reports(robot, client, *, emergency):
    stopping = threading.Thread(target=robot.stop, kwargs={"emergency": emergency}, daemon=True)
    started = time.monotonic()
    stopping.start()
    stopping.join(5.0)
    assert not stopping.is_alive()
    assert client.sent[0] == ("estop" if emergency else "abort")
    assert robot.outcome() is not None
    assert time.monotonic() - started < 5.0


def test_a_stop_is_sent_before_anything_else(robot, client, monkeypatch):
    sent_before_interruption = []
    monkeypatch.setattr(robot._executions, "interrupt", lambda: sent_before_interruption.extend(client.sent))
    robot.stop()
    robot.stop(emergency=True)
    assert sent_before_interruption == ["abort", "abort", "estop"]


def test_a_contract_that_cannot_be_recorded_is_rejected_and_blocks_no_other(robot, client, tmp_path, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(jsonl_log.os, "fsync", refuse_to_sync)
        refused = robot.call("submit_contract", {"contract": hold(robot, "c-0001"), "wait_s": 5})
    assert (refused["state"], client.executed) == ("rejected", [])
    assert str(tmp_path / "submissions.jsonl") in refused["rejected"]["got"]
    assert "No space left on device" in refused["rejected"]["got"]
    assert "submit" in refused["rejected"]["hint"]
    again = robot.call("submit_contract", {"contract": hold(robot, "c-0001"), "wait_s": 5})
    assert (again["outcome"]["succeeded"], client.executed) == (True, ["c-0001"])


def test_a_contract_that_the_end_of_the_program_refuses_is_rejected_in_the_file(robot, client, tmp_path, monkeypatch):
    """Its line is written, and the end of the program begins before its episode does."""
    with stalled_submission(robot, monkeypatch):
        robot._executions.begin_close()
    assert client.executed == []
    now = time.time()
    assert RetryLog(tmp_path / "submissions.jsonl", now=now).find("c-0001", "another contract", now) is None


def test_an_end_that_cannot_be_recorded_is_an_event_and_keeps_the_outcome(robot, client, monkeypatch):
    client.motion = 0.5
    robot.submit(hold(robot, "c-0001"))
    monkeypatch.setattr(jsonl_log.os, "fsync", refuse_to_sync)
    assert robot.outcome(timeout=10.0).succeeded
    deadline = time.monotonic() + 5.0
    while not any(event["kind"] == "recorder" for event in robot.events()) and time.monotonic() < deadline:
        time.sleep(0.01)
    assert "submissions.jsonl" in next(one["text"] for one in robot.events() if one["kind"] == "recorder")


class FullMemory(NoMemory):
    """A memory whose disk is full."""

    def store(self, *parts, **options):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_a_memory_that_fails_after_the_motion_leaves_the_outcome_with_a_warning(robot, client, monkeypatch):
    object.__setattr__(robot._executions._resources, "memory", FullMemory())
    report = robot.run(hold(robot, "c-0001"), timeout=10.0)
    assert (report.state, report.succeeded, client.executed) == ("finished", True, ["c-0001"])
    assert "is not stored in the memory" in report.warning
    assert "No space left on device" in report.warning
    assert report_view(report)["warning"] == report.warning
