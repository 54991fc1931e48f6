"""Ctrl-C, kill -9 and power that goes: the arm stands, what was recorded can be read, and the next start says it."""

import json
import os
import shutil
import signal
import subprocess
import sys
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

RUN = "import sys; from dualbrain.cli.main import run_command_line; sys.exit(run_command_line(sys.argv[1:]))"
PICK = contract_text(("grasp", GRASP), ("place", PLACE))


def in_the_middle(folder, name, number):
    """Run in `folder` and send signal `number` while the arm comes down; returns (exit code, stdout, stderr)."""
    (folder / "pick.json").write_text(PICK)
    command = [sys.executable, "-c", RUN, "run", "put it there", "--contract", "pick.json", "--headless", "--json"]
    command += ["--scene", "bare:0", "--ledger", "ledger.sqlite", "--out", name]
    environment = {**os.environ, "MUJOCO_GL": "disable", "COLUMNS": "500", "DUALBRAIN_HOME": str(folder)}
    process = subprocess.Popen(
        command, cwd=folder, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    heard = []
    for line in process.stderr:
        heard.append(line)
        if "grasp: descend" in line:
            time.sleep(0.1)
            process.send_signal(number)
            break
    out, err = process.communicate(timeout=60)
    return process.returncode, out, "".join(heard) + err


@pytest.fixture(scope="module")
def ctrl_c(tmp_path_factory):
    return run_once(tmp_path_factory, "ctrl_c", lambda folder: in_the_middle(folder, "one", signal.SIGINT))


def test_ctrl_c_in_the_middle_of_a_motion_brakes_and_leaves_with_130(ctrl_c):
    _, code, out, err = ctrl_c
    assert code == ExitCode.INTERRUPTED == 130
    assert "interrupted by a person: braking to rest" in err
    assert "drive off, brakes on" in err
    assert "Traceback" not in err
    told = json.loads(out)
    assert (told["outcome"], told["success"]) == ("aborted", False)


def test_ctrl_c_is_recorded_in_episode_and_ledger(ctrl_c):
    folder, *_ = ctrl_c
    episode = msgspec.json.decode((folder / "one" / "episode.json").read_bytes(), type=Episode)
    assert episode.outcome.kind == "aborted"
    assert [action.status for action in episode.outcome.actions] == ["stopped", "not_run"]
    (remembered,) = ledger_episodes(folder / "ledger.sqlite")
    assert remembered["episode"]["outcome"]["kind"] == "aborted"
    assert ledger_kinds(folder / "ledger.sqlite") == ["run_started", "episode", "run_ended"]


def test_the_recording_of_an_interrupted_run_is_whole_and_ends_at_rest(ctrl_c):
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
    return run_once(tmp_path_factory, "killed", lambda folder: in_the_middle(folder, "one", signal.SIGKILL))


def test_a_killed_run_leaves_a_ledger_that_holds_and_a_recording_that_can_be_read(killed):
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


def test_the_start_after_a_kill_says_what_was_interrupted(killed, tmp_path):
    folder = shutil.copytree(killed[0], tmp_path / "copy")
    story = run_session(run_config(folder, "two"), hold_contract())
    (cut,) = story.interrupted
    assert cut.run == "one"
    assert "Run one of" in str(cut)
    assert "was interrupted after its start" in str(cut)
    assert ledger_kinds(story.config.ledger)[:3] == ["run_started", "run_interrupted", "run_started"]
    assert run_session(run_config(folder, "three"), hold_contract()).interrupted == ()  # said once


# --- inside one process -------------------------------------------------------------------------------------------


def test_an_interruption_while_the_planner_thinks_moves_nothing(tmp_path):
    story = run_session(run_config(tmp_path), PICK, before=lambda session: session.interrupt())
    assert story.episode.outcome.kind == "aborted"
    assert story.episode.attempts == ()
    assert story.displacement < 1e-6
    assert exit_code(story.episode) == ExitCode.INTERRUPTED
    assert run_summary(story.episode, story.config.out)["verdict"] is None
    assert len(ledger_episodes(story.config.ledger)) == 1


def test_a_planner_that_never_answers_does_not_hold_up_an_interruption(tmp_path, monkeypatch):
    sessions = []

    def never(self, request):
        sessions[0].interrupt()
        time.sleep(60.0)

    monkeypatch.setattr(ScriptedPlanner, "propose", never)
    start = time.monotonic()
    story = run_session(run_config(tmp_path), before=sessions.append)
    assert story.episode.outcome.kind == "aborted"
    assert time.monotonic() - start < 30.0


def test_a_planner_that_raises_stops_the_robot_and_the_run_is_found_by_the_next(tmp_path, monkeypatch):
    def broken(self, request):
        raise ZeroDivisionError

    plants = []
    usual = ScriptedPlanner.propose
    monkeypatch.setattr(ScriptedPlanner, "propose", broken)
    with pytest.raises(ZeroDivisionError):
        run_session(run_config(tmp_path, "one"), before=lambda session: plants.append(session.plant))
    assert not plants[0].read().drive_enabled
    monkeypatch.setattr(ScriptedPlanner, "propose", usual)
    (cut,) = run_session(run_config(tmp_path, "two"), hold_contract()).interrupted
    assert cut.run == "one"


def test_after_an_interruption_the_drive_is_off(tmp_path):
    seen = []

    def before(session):
        seen.append(session)

    def phase(name):
        if name == "approach":
            seen[0].interrupt()

    story = run_session(run_config(tmp_path), PICK, before=before, observer=RunObserver(on_phase=phase))
    assert story.episode.outcome.kind == "aborted"
    assert not seen[0].plant.read().drive_enabled
