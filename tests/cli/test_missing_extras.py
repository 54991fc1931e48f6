"""An installation with the extra `cli` alone: help and doctor work, and other commands name their extra in one line."""

import os
import subprocess
import sys

import pytest

from dualbrain.cli.common.exit_codes import ExitCode

PROGRAM = """
import sys
from importlib.abc import MetaPathFinder
from dualbrain.core.lazy_exports import EXTRAS

class Blocked(MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if EXTRAS.get(name.partition(".")[0], "cli") != "cli":
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

sys.meta_path.insert(0, Blocked())
from dualbrain.cli.main import run_command_line
sys.exit(run_command_line(sys.argv[1:]))
"""


def without_extras(folder, *arguments):
    return subprocess.run(
        [sys.executable, "-c", PROGRAM, *arguments],
        cwd=folder,
        env={**os.environ, "DUALBRAIN_HOME": str(folder), "COLUMNS": "300"},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )


def test_help_and_doctor_work(tmp_path):
    assert "Commands" in without_extras(tmp_path, "--help").stdout
    done = without_extras(tmp_path, "doctor")
    assert (done.returncode, done.stderr) == (ExitCode.SUCCESS, "")
    for words in ("kernel", "filter step", "planner starter-135m", "the package mujoco is not installed"):
        assert words in done.stdout


@pytest.mark.parametrize(
    "command",
    [
        ("run", "put the red cube in the bowl"),
        ("plan", "put the red cube in the bowl"),
        ("demo", "--headless"),
        ("replay", "x.mcap"),
        ("export", "lerobot", "x.mcap", "--out", "y"),
        ("fault", "state", "off"),
        ("gatekeeper",),
        ("console",),
        ("evaluate", "--dry-run"),
        ("report", "x"),
        ("compare", "x", "y"),
        ("knowledge", "list"),
        ("robot", "identify"),
        ("robot", "conform"),
    ],
)
def test_a_missing_extra_is_one_line_with_the_install_command(tmp_path, command):
    (tmp_path / "x.mcap").write_bytes(b"\x89MCAP0\r\n")  # only the first bytes are read without the extra
    done = without_extras(tmp_path, *command)
    assert (done.returncode, done.stdout) == (ExitCode.SETUP, "")
    *announced, message = done.stderr.splitlines()
    assert len(announced) <= 1  # what the command is doing
    assert "Install it with `pip install 'dualbrain[" in message


@pytest.mark.parametrize("command", [("schema",), ("models", "list"), ("robot", "inspect", "panda")])
def test_commands_that_need_no_extra_work(tmp_path, command):
    done = without_extras(tmp_path, *command)
    assert (done.returncode, done.stderr) == (ExitCode.SUCCESS, "")
