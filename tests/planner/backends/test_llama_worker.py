"""The worker process ends with its parent, even while C code holds the global interpreter lock."""

import os
import subprocess
import sys
import time
from pathlib import Path

from dualbrain.planner.backends import llama_worker

LOADING = f"""
import ctypes, sys
sys.path.insert(0, {str(Path(llama_worker.__file__).parent)!r})
from llama_worker import _exit_when_closed
_exit_when_closed(sys.stdin.fileno())
print("loading", flush=True)
ctypes.PyDLL(None).sleep(60)
"""
"""A process that holds the interpreter lock, like one that loads a model."""


def test_the_worker_runs_until_its_parent_ends():
    child = subprocess.Popen([sys.executable, "-S", "-c", LOADING], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    with child:
        assert child.stdout.readline() == b"loading\n"
        time.sleep(0.2)
        assert child.poll() is None
        child.stdin.close()
        assert child.wait(timeout=5.0) != 0


def test_a_parent_that_has_ended_before_is_detected():
    read, write = os.pipe()
    os.close(write)
    command = [sys.executable, "-S", "-c", LOADING]
    done = subprocess.run(command, stdin=read, timeout=20.0, check=False, capture_output=True)
    os.close(read)
    assert (done.returncode, done.stdout) == (0, b"")
