"""Ctrl-C, SIGKILL and power loss: the arm stops, the recording can be read, and the next start reports the run."""

import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time

import msgspec
import numpy as np
import pytest

from dualbrain.cli.common.exit_codes import ExitCode
from dualbrain.cli.run.execution import exit_code, run_summary
from dualbrain.control.recording.channels import read_trace, recording_state
from dualbrain.control.recording.replay import replay
from dualbrain.planner.scripted import ScriptedPlanner
from dualbrain.records import Episode
from dualbrain.robots.loader import load_robot
from dualbrain.runtime.session import RunObserver
from tests.stories.story_session import (
    GRASP,
    PLACE,
    contract_text,
    hold_contract,
    ledger_episodes,
    ledger_kinds,
    run_config,
    run_session,
)
from tests.support.run_once import run_once

CLI_PROGRAM = """
import os, sys, time
from pathlib import Path
from dualbrain.cli.main import run_command_line
from dualbrain.control.recording.channels import read_trace

class SignallingStderr:
    "Standard error that sends this process a signal during the descent, once the start of the run is on disk."

    def __init__(self, stream, number, recording):
        self.stream, self.number, self.recording, self.written = stream, number, recording, ""

    def write(self, text):
        self.written += text
        if self.number and "grasp: descend" in self.written:
            number, self.number = self.number, 0
            while (trace := read_trace(self.recording)) is None or len(trace) <= 500:
                time.sleep(0.02)
            os.kill(os.getpid(), number)
        return self.stream.write(text)

    def __getattr__(self, name):
        return getattr(self.stream, name)

number, recording, *arguments = sys.argv[1:]
sys.stderr = SignallingStderr(sys.stderr, int(number), Path(recording))
sys.exit(run_command_line(arguments))
"""
PICK = contract_text(("grasp", GRASP), ("place", PLACE))


def signal_during_descent(folder, name, number):
    """Run in `folder`; the process gets signal `number` while the arm descends. Returns (exit code, stdout, stderr).

    The process sends the signal to itself, so that its moment does not depend on the load of the machine.
    """
    (folder / "pick.json").write_text(PICK)
    recording = folder / name / "episode.mcap"
    command = [sys.executable, "-c", CLI_PROGRAM, str(int(number)), str(recording)]
    command += ["run", "put it there", "--contract", "pick.json", "--headless", "--json"]
    command += ["--scene", "bare:0", "--ledger", "ledger.sqlite", "--out", name]
    environment = {**os.environ, "MUJOCO_GL": "disable", "COLUMNS": "500", "DUALBRAIN_HOME": str(folder)}
    ended = subprocess.run(
        command, check=False, cwd=folder, env=environment, capture_output=True, text=True, timeout=120
    )
    return ended.returncode, ended.stdout, ended.stderr


@pytest.fixture(scope="module")
def ctrl_c(tmp_path_factory):
    return run_once(tmp_path_factory, "ctrl_c", lambda folder: signal_during_descent(folder, "one", signal.SIGINT))


def test_ctrl_c_during_a_motion_brakes_and_exits_with_130(ctrl_c):
    _, code, out, err = ctrl_c
    assert code == ExitCode.INTERRUPTED == 130
    assert "interrupted by a person: braking to rest" in err
    assert "drive off, brakes on" in err
    assert "Traceback" not in err
    result = json.loads(out)
    assert (result["outcome"], result["success"]) == ("aborted", False)


def test_ctrl_c_is_recorded_in_episode_and_ledger(ctrl_c):
    folder, *_ = ctrl_c
    episode = msgspec.json.decode((folder / "one" / "episode.json").read_bytes(), type=Episode)
    assert episode.outcome.kind == "aborted"
    assert [action.status for action in episode.outcome.actions] == ["stopped", "not_run"]
    (remembered,) = ledger_episodes(folder / "ledger.sqlite")
    assert remembered["episode"]["outcome"]["kind"] == "aborted"
    assert ledger_kinds(folder / "ledger.sqlite") == ["run_started", "episode", "run_ended"]


def test_the_recording_of_an_interrupted_run_is_complete_and_ends_at_rest(ctrl_c):
    folder, *_ = ctrl_c
    path = folder / "one" / "episode.mcap"
    assert recording_state(path).complete
    trace = read_trace(path)
    assert np.abs(trace["v"][-1]).max() < 1e-2
    assert np.abs(trace["u"][-1]).max() < 1e-3
    limit = 1e-3 * np.array([joint.acceleration.value for joint in load_robot("panda").joints])  # in one tick
    assert np.all(np.abs(np.diff(trace["u"], axis=0)) <= limit * (1 + 1e-5) + 1e-6)
    assert replay(path).identical


@pytest.fixture(scope="module")
def killed(tmp_path_factory):
    return run_once(tmp_path_factory, "killed", lambda folder: signal_during_descent(folder, "one", signal.SIGKILL))


def test_a_killed_run_leaves_an_intact_ledger_and_a_readable_recording(killed):
    folder, code, *_ = killed
    assert code == -signal.SIGKILL
    assert ledger_kinds(folder / "ledger.sqlite") == ["run_started"]
    state = recording_state(folder / "one" / "episode.mcap")
    assert not state.complete
    assert state.problem
    trace = read_trace(folder / "one" / "episode.mcap")
    assert len(trace) > 500
    assert replay(folder / "one" / "episode.mcap").identical
    assert not (folder / "one" / "episode.json").exists()


def test_the_start_after_a_kill_reports_the_interrupted_run(killed, tmp_path):
    folder = shutil.copytree(killed[0], tmp_path / "copy")
    story = run_session(run_config(folder, "two"), hold_contract())
    (interrupted,) = story.interrupted
    assert interrupted.run == "one"
    assert "Run one of" in str(interrupted)
    assert "was interrupted after its start" in str(interrupted)
    assert ledger_kinds(story.config.ledger)[:3] == ["run_started", "run_interrupted", "run_started"]
    assert run_session(run_config(folder, "three"), hold_contract()).interrupted == ()  # reported once


# --- inside one process -------------------------------------------------------------------------------------------


def test_an_interruption_during_planning_moves_nothing(tmp_path):
    story = run_session(run_config(tmp_path), PICK, before=lambda session: session.interrupt())
    assert story.episode.outcome.kind == "aborted"
    assert story.episode.attempts == ()
    assert story.displacement < 1e-6
    assert exit_code(story.episode) == ExitCode.INTERRUPTED
    assert run_summary(story.episode, story.config.out)["verdict"] is None
    assert len(ledger_episodes(story.config.ledger)) == 1


@pytest.mark.realtime
def test_a_planner_that_never_answers_does_not_delay_an_interruption(tmp_path, monkeypatch):
    sessions, never = [], threading.Event()

    def propose_forever(self, request):
        sessions[0].interrupt()
        never.wait(60.0)

    monkeypatch.setattr(ScriptedPlanner, "propose", propose_forever)
    start = time.monotonic()
    story = run_session(run_config(tmp_path), before=sessions.append)
    assert story.episode.outcome.kind == "aborted"
    assert time.monotonic() - start < 30.0
    never.set()


def test_a_planner_that_raises_stops_the_robot_and_the_next_run_reports_it(tmp_path, monkeypatch):
    def raise_error(self, request):
        raise ZeroDivisionError

    plants = []
    propose = ScriptedPlanner.propose
    monkeypatch.setattr(ScriptedPlanner, "propose", raise_error)
    with pytest.raises(ZeroDivisionError):
        run_session(run_config(tmp_path, "one"), before=lambda session: plants.append(session.plant))
    assert not plants[0].read().drive_enabled
    monkeypatch.setattr(ScriptedPlanner, "propose", propose)
    (interrupted,) = run_session(run_config(tmp_path, "two"), hold_contract()).interrupted
    assert interrupted.run == "one"


def test_after_an_interruption_the_drive_is_off(tmp_path):
    sessions = []

    def interrupt(phase):
        if phase == "approach":
            sessions[0].interrupt()

    observer = RunObserver(on_phase=interrupt)
    story = run_session(run_config(tmp_path), PICK, before=sessions.append, observer=observer)
    assert story.episode.outcome.kind == "aborted"
    assert not sessions[0].plant.read().drive_enabled
