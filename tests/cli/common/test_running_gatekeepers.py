"""Gatekeepers in the list of `dualbrain doctor`: registered or not, hung, stale entries, and a closed terminal."""

import fcntl
import os
import pty
import signal
import subprocess
import sys
import termios
import time
from contextlib import closing, contextmanager

import msgspec
import pytest

from dualbrain.cli import doctor
from dualbrain.cli.common import running_gatekeepers as module
from dualbrain.cli.common.running_gatekeepers import REGISTRATIONS, running_gatekeepers
from dualbrain.control.gatekeeper.config import GatekeeperConfig
from dualbrain.control.gatekeeper.process import GatekeeperProcess
from dualbrain.control.gatekeeper.protocol.authentication import PRINCIPALS, load_keys
from dualbrain.control.gatekeeper.protocol.client import GatekeeperClient
from dualbrain.control.gatekeeper.protocol.registration import Registration, process_start_ticks, registered
from dualbrain.simulation.scenes.generators.catalogue import open_scene

LIMIT = 30.0
"""Longest wait [s] for another process."""


def wait_for(condition):
    deadline = time.monotonic() + LIMIT
    while not (found := condition()):
        assert time.monotonic() < deadline
        time.sleep(0.05)
    return found


def mine(home, pid):
    return next((one for one in running_gatekeepers(home) if one.pid == pid), None)


def is_running(pid):
    return process_start_ticks(pid) is not None


# --- registrations ------------------------------------------------------------------------------------------------


def registration(**changes):
    values = {
        "pid": os.getpid(),
        "start_ticks": process_start_ticks(os.getpid()),
        "robot": "panda",
        "socket": "/nowhere/s",
        "keys": "/nowhere/keys",
        "started_by": "a test",
    }
    return Registration(**values | changes)


def test_stale_and_damaged_registrations_are_left_out(tmp_path):
    folder = tmp_path / REGISTRATIONS
    folder.mkdir()
    dead = subprocess.Popen([sys.executable, "-c", ""])
    dead.wait()
    reused = registration(start_ticks=registration().start_ticks - 1)
    for name, content in (
        ("1", msgspec.json.encode(registration(pid=dead.pid, start_ticks=5))),
        ("2", msgspec.json.encode(registration(pid=dead.pid, start_ticks=None))),
        ("3", msgspec.json.encode(reused)),
        ("4", b'{"pid": 1'),
        ("5", b"\xff\xfe"),
        ("6", b"[" * 100_000),
        ("7", b""),
        ("8", msgspec.json.encode({"pid": "many"})),
    ):
        (folder / f"{name}.json").write_bytes(content)
    (folder / "9.json").mkdir()
    (folder / "10.json").symlink_to(folder / "missing")
    assert all(one.pid not in (os.getpid(), dead.pid) for one in running_gatekeepers(tmp_path))


def test_a_running_one_that_does_not_answer_is_a_problem_with_its_remedy(tmp_path, monkeypatch):
    with registered(
        tmp_path / REGISTRATIONS,
        robot="ur5e",
        socket=str(tmp_path / "s"),
        keys=str(tmp_path / "k"),
        started_by="a test",
    ):
        monkeypatch.setattr(doctor, "dualbrain_home", lambda: tmp_path)
        found = next(one for one in doctor._gatekeepers() if one.item == f"gatekeeper {os.getpid()}")
        assert found.state == "problem"
        for part in ("ur5e", str(tmp_path / "s"), "since 20", "started by a test", "does not answer", "kill "):
            assert part in found.text
    assert not list((tmp_path / REGISTRATIONS).iterdir())


def test_one_that_is_shutting_down_is_left_out(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "_from_process_list", lambda: iter(()))
    (tmp_path / REGISTRATIONS).mkdir()
    ending = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(0.5)"])
    entry = registration(pid=ending.pid, start_ticks=process_start_ticks(ending.pid), socket=str(tmp_path / "s"))
    (tmp_path / REGISTRATIONS / "1.json").write_bytes(msgspec.json.encode(entry))
    assert running_gatekeepers(tmp_path) == []
    assert ending.wait(LIMIT) == 0


def test_one_that_is_starting_is_asked_until_it_answers(tmp_path, monkeypatch):
    answers = iter([(None, "it does not answer"), (None, "it sends no status"), (True, "")])
    monkeypatch.setattr(module, "_from_process_list", lambda: iter([registration()]))
    monkeypatch.setattr(module, "_ask_for_commander", lambda socket: next(answers))
    assert [(one.pid, one.commander) for one in running_gatekeepers(tmp_path)] == [(os.getpid(), True)]


def test_a_new_registration_removes_stale_ones_and_a_read_only_folder_stops_nothing(tmp_path):
    (tmp_path / "1.json").write_bytes(b"junk")
    options = {"robot": "panda", "socket": "s", "keys": "k", "started_by": "a test"}
    with registered(tmp_path, **options):
        assert [path.name for path in tmp_path.iterdir()] == [f"{os.getpid()}.json"]
    (tmp_path / "file").write_bytes(b"")
    with registered(tmp_path / "file" / "folder", **options):
        pass


def test_without_gatekeepers_doctor_states_that_none_is_running(monkeypatch, tmp_path):
    monkeypatch.setattr(doctor, "dualbrain_home", lambda: tmp_path)
    monkeypatch.setattr(module, "_from_process_list", lambda: iter(()))
    assert [(one.state, one.text) for one in doctor._gatekeepers()] == [("ok", "none is running")]


def test_a_relative_data_folder_is_that_of_the_process(tmp_path):
    """Its socket was looked for in the folder of the command, so an emergency stop did not reach the gatekeeper."""
    sleeper = [sys.executable, "-c", "print('ready', flush=True); input()"]
    environ = os.environ | {"DUALBRAIN_HOME": "data"}
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    with subprocess.Popen(sleeper, cwd=tmp_path, env=environ, **pipes) as process:
        assert process.stdout.readline() == b"ready\n"  # the environment of a process that starts is empty for a moment
        found = wait_for(lambda: module._started_by_person(process.pid, ["dualbrain", "gatekeeper"]))
        process.communicate(b"\n")
    assert (found.socket, found.keys) == (str(tmp_path / "data" / "gatekeeper.sock"), str(tmp_path / "data" / "keys"))


# --- real processes -------------------------------------------------------------------------------------------------


@contextmanager
def gatekeeper_of_a_person(home, *arguments):
    """`dualbrain gatekeeper` in a terminal of its own; yields the process and the terminal's master end."""
    master, slave = pty.openpty()

    def take_terminal():
        fcntl.ioctl(slave, termios.TIOCSCTTY, 0)

    command = [sys.executable, *(["-S"] if sys.flags.no_site else []), "-m", "dualbrain", "gatekeeper"]
    process = subprocess.Popen(
        [*command, "--scene", "bare:0", *arguments],
        stdin=slave,
        stdout=slave,
        stderr=slave,
        start_new_session=True,
        preexec_fn=take_terminal,  # noqa: PLW1509  (the child only takes its terminal)
        env=os.environ | {"DUALBRAIN_HOME": str(home)},
        cwd=home,
    )
    os.close(slave)
    try:
        yield process, master
    finally:
        if process.poll() is None:
            process.kill()
        process.wait()


@pytest.mark.realtime
def test_a_gatekeeper_of_a_person_survives_its_terminal_and_its_commander(tmp_path):
    with gatekeeper_of_a_person(tmp_path) as (process, master):
        wait_for((tmp_path / REGISTRATIONS / f"{process.pid}.json").exists)
        os.close(master)  # the terminal closes: SIGHUP, and every write to it fails from now on
        time.sleep(0.5)
        keys = load_keys(tmp_path / "keys", PRINCIPALS)
        with closing(GatekeeperClient(tmp_path / "gatekeeper.sock", keys, "planner")):
            found = mine(tmp_path, process.pid)
            assert (found.robot, found.commander, found.problem) == ("panda", True, "")
            assert found.started_by == "a person with `dualbrain gatekeeper`"
        wait_for(lambda: mine(tmp_path, process.pid).commander is False)
        elsewhere = mine(tmp_path / "other", process.pid)
        assert (elsewhere.socket, elsewhere.keys) == (tmp_path / "gatekeeper.sock", tmp_path / "keys")
        assert f"--socket {tmp_path / 'gatekeeper.sock'}" in elsewhere.ending
        with closing(GatekeeperClient(tmp_path / "gatekeeper.sock", keys, "operator")) as operator:
            wait_for(lambda: operator.status)
            assert not operator.status.busy  # at rest; on a busy machine the supervisor may have stopped the arm
            operator.operate("shut_down")
            assert process.wait(LIMIT) == 0
    assert mine(tmp_path, process.pid) is None
    assert not list((tmp_path / REGISTRATIONS).iterdir())


@pytest.mark.realtime
def test_ctrl_c_in_the_terminal_reaches_the_gatekeeper_only_and_the_drive_is_switched_off_by_it(tmp_path):
    with gatekeeper_of_a_person(tmp_path, "--socket", "own.sock") as (process, master):
        wait_for((tmp_path / REGISTRATIONS / f"{process.pid}.json").exists)
        os.write(master, b"\x03")
        assert process.wait(LIMIT) == 0
        output = os.read(master, 100_000).decode()
        assert "listens at own.sock" in output
        assert "KeyboardInterrupt" not in output
        os.close(master)


@pytest.mark.realtime
def test_a_spawned_gatekeeper_is_found_without_a_registration_and_a_hung_one_is_a_problem(tmp_path):
    config = GatekeeperConfig(
        robot="panda", scene=open_scene("bare:0"), socket=str(tmp_path / "s"), keys=str(tmp_path / "keys")
    )
    process = GatekeeperProcess(config)
    pid = process.process.pid
    try:
        found = mine(tmp_path / "home", pid)
        assert (found.robot, found.commander, found.parent) == ("panda", False, os.getpid())
        assert found.started_by == "a program"
        os.kill(pid, signal.SIGSTOP)
        hung = mine(tmp_path / "home", pid)
        assert hung.commander is None
        assert f"kill {pid}" in hung.ending
    finally:
        os.kill(pid, signal.SIGCONT)
        process.stop()
    assert mine(tmp_path / "home", pid) is None
