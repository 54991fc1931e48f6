"""The shell: every instruction is a run of its own, the world continues, and a stop ends the motion only."""

import json
import os
import sys
from threading import Event

import pytest
from rich.console import Console

from dualbrain.cli.common.exit_codes import ExitCode
from dualbrain.cli.run.shell.commands import SHELL_COMMANDS
from dualbrain.cli.run.shell.options import ShellOptions
from dualbrain.cli.run.shell.worker import BUSY, InstructionWorker
from dualbrain.errors import ConfigurationError
from dualbrain.planner.scripted import ScriptedPlanner
from dualbrain.runtime import run_resources, session
from dualbrain.runtime.backends import simulated
from dualbrain.runtime.run_folder import RUN_FILES
from tests.stories.story_session import GRASP, PLACE, contract_text, hold_contract, ledger_episodes


@pytest.fixture
def scripted(monkeypatch):
    """Planners with the given answers, and no delay for planning."""
    monkeypatch.setattr(simulated, "PLANNING_TIME", 0.02)

    def use(*answers):
        monkeypatch.setattr(run_resources, "open_planner", lambda *_, **__: ScriptedPlanner(answers))

    return use


@pytest.fixture
def shell(run_command, monkeypatch, tmp_path):
    """Run `dualbrain shell` with the given lines on standard input."""

    def run(*lines, scene="bare:0"):
        path = tmp_path / "lines.txt"
        path.write_text("\n".join(lines))
        with path.open() as stream:
            monkeypatch.setattr(sys, "stdin", stream)
            return run_command("shell", "--headless", "--scene", scene, "--out", "runs")

    return run


def run_folders(tmp_path):
    return sorted((tmp_path / "runs").iterdir(), key=lambda path: path.stat().st_mtime_ns)


def test_objects_stay_where_they_were_put_and_every_instruction_is_a_run(shell, scripted, tmp_path):
    scripted(contract_text(("grasp", GRASP)), contract_text(("place", PLACE)))
    code, out, err = shell("pick up the red cube", "scene", "put the red cube in the bowl", "scene", "history", "quit")
    assert code == ExitCode.SUCCESS, err
    assert err.index("in the hand") < err.index("in blue_bowl")
    assert err.count("succeeded") >= 2
    first, second = run_folders(tmp_path)
    for folder in (first, second):
        assert {path.name for path in folder.iterdir()} == set(RUN_FILES)
        assert str(folder.relative_to(tmp_path)) in err
    assert json.loads((second / "config.json").read_bytes())["after"] == str(first.relative_to(tmp_path))
    stored = ledger_episodes(tmp_path / "ledger.sqlite")
    assert [one["episode"]["instruction"] for one in stored] == ["pick up the red cube", "put the red cube in the bowl"]
    assert out == ""


def test_the_exit_code_is_that_of_the_last_instruction_that_was_not_carried_out(shell, scripted):
    scripted("no contract", "still none", hold_contract())
    code, _, err = shell("put the red cube in the bowl", "rest")
    assert "rejected" in err
    assert code == ExitCode.REJECTED


def test_a_scene_that_does_not_exist_ends_the_shell_with_its_message(shell, scripted):
    scripted(hold_contract())
    code, _, err = shell("rest", scene="bear:0")
    assert code == ExitCode.SETUP
    assert "bear" in err
    assert "bare" in err


def test_every_command_answers_before_the_first_instruction(shell, scripted, tmp_path):
    scripted(hold_contract())
    code, out, err = shell(*(word for word in SHELL_COMMANDS if word not in ("home", "memory")))
    assert (code, out) == (ExitCode.SUCCESS, "")
    for words in ("Ctrl-D", "red_cube", "No instruction was given yet.", "cannot be undone", "at the start"):
        assert words in err
    assert not (tmp_path / "runs").exists()


# --- the worker -----------------------------------------------------------------------------------------------------


@pytest.fixture
def worker(scripted, monkeypatch, tmp_path):
    """A worker that is ready, with `wait()` until it is idle again."""
    monkeypatch.setenv("DUALBRAIN_HOME", str(tmp_path))
    scripted(hold_contract(4.0))
    idle = Event()
    options = ShellOptions(scene="bare:0", out=tmp_path / "runs", live_view=False)
    with open(os.devnull, "w", encoding="utf-8") as nothing:
        worker = InstructionWorker(options, Console(file=nothing), idle.set)

        def wait():
            assert idle.wait(60.0)
            idle.clear()

        wait()
        yield worker, wait
        worker.interrupt()
        worker.close()


def test_a_stop_ends_the_motion_and_the_next_instruction_is_carried_out(worker):
    worker, wait = worker
    assert worker.submit("rest") == ""
    assert worker.submit_from_page("rest") == BUSY
    assert worker.submit_from_page("stop") == ""
    wait()
    assert worker.submit("rest") == ""
    wait()
    assert [one.code for one in worker.history] == [ExitCode.INTERRUPTED, ExitCode.SUCCESS]


def test_a_refused_set_up_is_recorded_and_the_worker_continues(worker, monkeypatch):
    worker, wait = worker

    def refuse(*_, **__):
        raise ConfigurationError.stating("The ledger is in use.")

    with monkeypatch.context() as patched:
        patched.setattr(session, "open_resources", refuse)
        worker.submit("rest")
        wait()
    worker.submit("rest")
    wait()
    assert [one.code for one in worker.history] == [ExitCode.SETUP, ExitCode.SUCCESS]
