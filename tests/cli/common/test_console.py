"""A reader who leaves: the account falls silent, the answer goes nowhere, and the exit code stays what it was."""

import os
import subprocess
import sys

TELL = """
import sys
from dualbrain.cli.common.console import Account, answer
console = Account()
sys.stdin.readline()
for _ in range(3):
    console.print("a line for people")
answer("{}")
sys.exit(4)
"""


def left_alone(**pipes):
    """The exit code of a program whose reader of `pipes` leaves before it says anything."""
    process = subprocess.Popen([sys.executable, "-c", TELL], stdin=subprocess.PIPE, text=True, **pipes)
    for name, target in pipes.items():
        if target == subprocess.PIPE:
            getattr(process, name).close()
            setattr(process, name, None)
    process.stdin.write("\n")
    process.stdin.flush()
    process.wait(timeout=60)
    process.stdin.close()
    return process.returncode


def test_nobody_reads_stderr(tmp_path):
    with (tmp_path / "out").open("w") as out:
        assert left_alone(stderr=subprocess.PIPE, stdout=out) == 4
    assert (tmp_path / "out").read_text() == "{}\n"


def test_nobody_reads_stdout(tmp_path):
    with (tmp_path / "err").open("w") as err:
        assert left_alone(stdout=subprocess.PIPE, stderr=err) == 4
    assert (tmp_path / "err").read_text().splitlines() == ["a line for people"] * 3


def test_a_listing_whose_reader_leaves_ends_quietly(tmp_path):
    command = "import sys; from dualbrain.cli.main import call; sys.stdin.readline(); sys.exit(call(['schema']))"
    process = subprocess.Popen(
        [sys.executable, "-c", command],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        env={**os.environ, "PYTHONUNBUFFERED": ""},
    )
    process.stdout.close()
    process.stdout = None
    _, err = process.communicate(b"\n", timeout=60)
    assert process.returncode == 0
    assert err == b""
