"""A process ends at once with its output, and at its deadline although its main thread hangs."""

import os
import subprocess
import sys

import pytest

LIMIT = 30.0
"""Longest wait [s] of a test for another process."""
AT_ONCE = """
import atexit, logging, sys, threading, time
from dualbrain.core.processes.process_end import end_process
atexit.register(print, "clean-up of the interpreter")
threading.Thread(target=time.sleep, args=(60.0,)).start()
sys.stdout.write("printed")
end_process(3)
"""
AT_THE_DEADLINE = """
import os, time
from dualbrain.core.processes.process_end import EndDeadline
def before_end():
    os.write(1, b"before the end")
    {problem}
deadline = EndDeadline(0.1, before_end, code=3)
deadline.start()
deadline.start()
time.sleep(60.0)
"""


def run(program):
    buffered = {name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"}
    command = [sys.executable, "-c", program]
    done = subprocess.run(command, stdout=subprocess.PIPE, timeout=LIMIT, check=False, env=buffered)
    return done.returncode, done.stdout


def test_a_process_ends_at_once_with_what_it_has_printed():
    assert run(AT_ONCE) == (3, b"printed")


@pytest.mark.parametrize("problem", ["pass", "raise SystemExit"])
def test_a_process_that_hangs_ends_at_its_deadline(problem):
    assert run(AT_THE_DEADLINE.format(problem=problem)) == (3, b"before the end")
