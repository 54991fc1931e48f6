"""A child ends with its parent: when the pipe is closed, when the parent is killed, and when its clean-up hangs."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from dualbrain.core.processes.parent_pipe import PARENT_ENDED, start_child
from tests.support.process_state import process_state

ROOT = Path(__file__).parents[3]
CHILD = "tests.core.processes.parent_pipe_child"
LIMIT = 10.0
"""Longest wait [s] of a test for another process."""

PARENT = f"""
import os, sys, time
from dualbrain.core.processes.parent_pipe import start_child
child = start_child({CHILD!r}, b"x" * 9, *sys.argv[1:])
if os.fork() == 0:  # inherits the write end of the pipe
    os.closerange(1, 3)
    time.sleep(10.0)
    os._exit(0)
print(child.pid, flush=True)
time.sleep(60.0)
"""


@pytest.fixture(autouse=True)
def in_the_root_folder(monkeypatch):
    monkeypatch.chdir(ROOT)


def wait_for(condition):
    deadline = time.monotonic() + LIMIT
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)


def test_the_child_gets_its_settings_and_a_session_of_its_own(tmp_path):
    size = 300_000  # more than the pipe holds
    child = start_child(CHILD, b"x" * size, "return", str(tmp_path / "a"))
    assert child.wait(LIMIT) == 0
    child.stdin.close()
    assert (tmp_path / "a").read_text() == f"{child.pid} {size} {child.pid}"


@pytest.mark.parametrize(("kind", "reports"), [("report", True), ("hang", False), ("raise", False)])
def test_closing_the_pipe_calls_the_callback_and_ends_the_child_after_its_grace(tmp_path, kind, reports):
    child = start_child(CHILD, b"", kind, str(tmp_path / "a"))
    wait_for((tmp_path / "a").exists)
    assert child.poll() is None
    child.stdin.close()
    assert child.wait(LIMIT) == PARENT_ENDED
    assert (tmp_path / "a.end").exists() == reports


def test_before_the_child_has_a_callback_the_end_of_the_pipe_ends_it_at_once(tmp_path):
    child = start_child(CHILD, b"settings that are never read", "hang at start", str(tmp_path / "a"))
    wait_for((tmp_path / "a").exists)
    child.stdin.close()
    assert child.wait(LIMIT) == PARENT_ENDED


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGHUP, signal.SIGTERM])
@pytest.mark.parametrize("kind", ["report", "hang at start"])
def test_the_end_of_the_parent_ends_the_child_although_another_process_inherited_the_pipe(tmp_path, number, kind):
    path = tmp_path / "a"
    with subprocess.Popen(
        [sys.executable, *(["-S"] if sys.flags.no_site else []), "-c", PARENT, kind, str(path)],
        stdout=subprocess.PIPE,
        start_new_session=True,
    ) as parent:
        pid = int(parent.stdout.readline())
        wait_for(path.exists)
        assert process_state(pid)
        parent.send_signal(number)
        parent.wait()
        wait_for(lambda: not process_state(pid))
        os.killpg(parent.pid, signal.SIGKILL)


def test_a_child_whose_parent_ended_before_it_started_ends_at_once(tmp_path):
    command = [sys.executable, *(["-S"] if sys.flags.no_site else []), "-m", "dualbrain.core.processes.parent_pipe"]
    read_end, write_end = os.pipe()
    try:
        arguments = ["1", CHILD, "hang at start", str(tmp_path / "a")]
        done = subprocess.run([*command, *arguments], stdin=read_end, timeout=LIMIT, check=False)
    finally:
        os.close(read_end)
        os.close(write_end)
    assert done.returncode == PARENT_ENDED
