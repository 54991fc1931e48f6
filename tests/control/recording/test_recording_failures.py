"""A recording that cannot be written: the failure is reported at once, the arm comes to rest, and no row is lost."""

import errno
import os
import resource
import signal
import threading
import time
from contextlib import contextmanager

import numpy as np
import pytest

from dualbrain.contracts.contract import Action, Context, Contract
from dualbrain.control.control_loop import ControlLoopConfig
from dualbrain.control.recording import recording_file as module
from dualbrain.control.recording.channels import read_recording, read_trace, recording_state
from dualbrain.control.recording.flight_log import FlightLog
from dualbrain.control.recording.recorder import Recorder
from dualbrain.control.recording.recording_file import reserve_for_recording
from dualbrain.control.recording.replay import replay
from dualbrain.control.recording.trace import Event, Trace
from dualbrain.core.storage.atomic_files import FileWriteError
from dualbrain.errors import ConfigurationError
from dualbrain.robots.loader import load_robot
from dualbrain.runtime.assembly import CellOptions, SimulatedCell, open_world
from dualbrain.simulation.scenes.generators.catalogue import open_scene
from experiments.gatekeeper.commander_messages import PICK_AND_PLACE
from tests.control.recording.sample_ticks import append_ticks
from tests.support.small_disk import fill, mounted_disk

ACTIONS = tuple(Action(skill, params) for skill, params in PICK_AND_PLACE[:1])
STOPPED = ("stopped", "CONTROLLED_STOP")


@pytest.fixture
def small_disk(tmp_path):
    with mounted_disk(tmp_path / "disk", 24) as folder:
        yield folder


class Disk:
    """Replaces `os.write` of the recording; writes fail with `code` from the moment at which it is set."""

    def __init__(self, monkeypatch):
        self.code = self.left = 0
        write = os.write

        def limited(descriptor, data):
            if not self.code:
                return write(descriptor, data)
            if self.left:
                part = bytes(data[: self.left])
                self.left = 0
                return write(descriptor, part)
            raise OSError(self.code, os.strerror(self.code))

        monkeypatch.setattr(module.os, "write", limited)


def run(folder, at_event, *, unrecorded=False, reserve=True):
    """Execute a contract in simulation; `at_event(event)` may make the disk fail. Returns cell, outcome, recorder."""
    robot_model = load_robot("panda")
    trace, path = Trace(robot_model.n, robot_model.nq), folder / "episode.mcap"
    space = reserve_for_recording(path, unrecorded=unrecorded) if reserve else None
    with Recorder(path, trace, when_full="wait", reserve=space) as recorder:
        recorder.episode(0.0, {"robot": "panda", "guard": True})
        cell = SimulatedCell(
            robot_model,
            open_world(open_scene("bare:0"), robot_model, CellOptions()),
            log=FlightLog(trace, recorder, at_event),
            config=ControlLoopConfig(unrecorded=unrecorded),
        )
        outcome = cell.execute(Contract("c-1", Context("panda", ""), ACTIONS))
    cell.close()
    return cell, outcome, recorder


def wait_until(condition):
    deadline = time.monotonic() + 10.0
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.001)


def at_the_first_phase(act, number=1):
    """An observer of events that calls `act` once, when the arm begins to move or in a later phase."""
    phases = []

    def on_event(event):
        if event.kind == "phase":
            phases.append(event.text)
            if len(phases) == number:
                act()

    return on_event


def rows_are_equal(path, trace, count=None):
    back = read_trace(path)
    return np.array_equal(back.rows, trace.rows[: len(back) if count is None else count], equal_nan=True)


def test_a_full_disk_stops_the_arm_and_the_recording_is_complete_to_its_end(small_disk):
    cell, outcome, recorder = run(small_disk, at_the_first_phase(lambda: fill(small_disk)))
    path, trace = small_disk / "episode.mcap", cell.log.trace
    assert (outcome.kind, cell.loop.safety_controller.decision.action.name) == STOPPED
    for part in (str(path), "No space left on device", "Free some space"):
        assert part in outcome.reason
        assert part in recorder.failure
    (report,) = [one for one in trace.events if "cannot be written" in one.text and one.kind == "fault"]
    assert report.text == recorder.failure
    assert rows_are_equal(path, trace, len(trace)), "the rest of the recording was written into the reserved space"
    result = replay(path)
    assert (result.identical, result.complete, result.ticks) == (True, True, len(trace))
    moved = trace["t"][np.abs(trace["u"]).max(axis=1) > 1e-6]
    assert moved[-1] - report.t < 1.0, "the arm came to rest at once"


def test_an_operator_may_choose_to_move_on_unrecorded(small_disk):
    cell, outcome, recorder = run(small_disk, at_the_first_phase(lambda: fill(small_disk)), unrecorded=True)
    assert outcome.kind == "succeeded", outcome.reason
    assert "No space left" in recorder.failure
    assert any(one.text == recorder.failure for one in cell.log.trace.events), "it is reported all the same"


def test_a_disk_without_room_refuses_the_start_unless_the_operator_chose_otherwise(small_disk):
    fill(small_disk)
    with pytest.raises(ConfigurationError, match="the end of the recording cannot be reserved"):
        reserve_for_recording(small_disk / "episode.mcap", unrecorded=False)
    assert reserve_for_recording(small_disk / "episode.mcap", unrecorded=True) is None


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EIO, errno.EFBIG, errno.ENXIO])
def test_every_failed_write_stops_the_arm_and_all_rows_before_it_can_be_replayed(tmp_path, monkeypatch, code):
    disk = Disk(monkeypatch)

    def break_disk():
        disk.code, disk.left = code, 1000  # the last write is a short one

    cell, outcome, recorder = run(tmp_path, at_the_first_phase(break_disk, number=3))
    assert (outcome.kind, cell.loop.safety_controller.decision.action.name) == STOPPED
    assert os.strerror(code) in outcome.reason
    state = recording_state(tmp_path / "episode.mcap")
    assert not state.complete
    assert not recorder.close().complete
    assert os.strerror(code) in recorder.close().problem
    assert rows_are_equal(tmp_path / "episode.mcap", cell.log.trace)
    assert replay(tmp_path / "episode.mcap").ticks > 500
    assert replay(tmp_path / "episode.mcap").identical


def test_what_could_not_be_written_is_written_once_the_disk_works_again(tmp_path, monkeypatch):
    disk = Disk(monkeypatch)
    trace = Trace(7)
    recorder = Recorder(tmp_path / "a.mcap", trace, when_full="wait")
    for k, row in enumerate(append_ticks(trace, 3000)):
        if k == 1500:
            wait_until(recorder._queue.empty)
            disk.code, disk.left = errno.ENOSPC, 100
        recorder.tick(row)
    wait_until(lambda: recorder.failure)
    disk.code = 0
    state = recorder.close()
    assert not state.complete
    assert "No space left" in state.problem
    back = read_trace(tmp_path / "a.mcap")
    assert 1400 < len(back) < 3000
    assert np.array_equal(back.rows, trace.rows[: len(back)], equal_nan=True)
    assert recording_state(tmp_path / "a.mcap") == state


def test_a_deleted_folder_is_a_lost_recording(tmp_path):
    folder = tmp_path / "run"
    folder.mkdir()

    def delete():
        (folder / "episode.mcap").unlink()
        folder.rmdir()

    _, outcome, recorder = run(folder, at_the_first_phase(delete))
    assert outcome.kind == "stopped"
    assert "the file was deleted" in outcome.reason
    assert not recorder.close().complete


def test_the_limit_of_the_size_of_a_file_is_a_lost_recording(tmp_path):
    with size_limit(400_000):
        _, outcome, _ = run(tmp_path, lambda event: None, reserve=False)
    assert outcome.kind == "stopped"
    assert "ulimit -f" in outcome.reason
    result = replay(tmp_path / "episode.mcap")
    assert (result.identical, result.complete) == (True, False)
    assert result.ticks > 500


@contextmanager
def size_limit(size):
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, handler)


def test_a_recording_that_cannot_be_created_names_the_file_and_leaves_nothing_reserved(tmp_path):
    (tmp_path / "episode.mcap").mkdir()
    with pytest.raises(FileWriteError, match=r"episode\.mcap was not written: Is a directory"):
        run(tmp_path, lambda event: None)
    assert [path.name for path in tmp_path.iterdir()] == ["episode.mcap"]


def test_a_disk_that_is_too_slow_is_a_failure_while_it_loses_messages(tmp_path, monkeypatch):
    gate = threading.Event()
    monkeypatch.setattr("dualbrain.control.recording.recorder.encode", lambda message: gate.wait(10) and b"{}")
    recorder = Recorder(tmp_path / "a.mcap", Trace(7), capacity=4)
    assert recorder.failure == ""
    for k in range(10):
        recorder.call(k * 0.01, "reset")
    assert "slower than the control loop" in recorder.failure
    gate.set()
    wait_until(recorder._queue.empty)
    recorder.call(1.0, "reset")
    assert recorder.failure == ""
    recorder.close()


def test_without_a_failure_nothing_is_reported(tmp_path):
    cell, outcome, recorder = run(tmp_path, lambda event: None)
    assert outcome.kind == "succeeded"
    assert recorder.failure == cell.log.recording_failure == ""
    events = [one.text for one in read_recording(tmp_path / "episode.mcap") if isinstance(one, Event)]
    assert not any("cannot be written" in text for text in events)
    assert [path.name for path in tmp_path.iterdir()] == ["episode.mcap"]
