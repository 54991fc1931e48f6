"""One completed run of the command line, shared by all tests that only read its results."""

import os
import subprocess
import sys

from tests.stories.story_session import GRASP, PLACE, contract_text
from tests.support.run_once import run_once

CLI_PROGRAM = "import sys; from dualbrain.cli.main import run_command_line as run; sys.exit(run(sys.argv[1:]))"


def run_command(folder, *arguments, **environment):
    """`dualbrain ARGUMENTS` in a separate process, with `folder` as home and working folder."""
    home = {"DUALBRAIN_HOME": str(folder), "COLUMNS": "500"}
    return subprocess.run(
        [sys.executable, "-c", CLI_PROGRAM, *arguments],
        cwd=folder,
        env={**os.environ, **home, **environment},
        capture_output=True,
        text=True,
        check=False,
    )


def _run_pick(folder):
    (folder / "pick.json").write_text(contract_text(("grasp", GRASP), ("place", PLACE)))
    done = run_command(
        folder,
        "run",
        "put the red cube in the bowl",
        "--contract",
        "pick.json",
        "--headless",
        "--json",
        "--scene",
        "bare:0",
        "--out",
        "run",
    )
    return done.returncode, done.stdout, done.stderr


def completed_run(factory):
    """(folder, exit code, stdout, stderr) of a pick and place on the bare scene; the run folder is folder/run."""
    return run_once(factory, "finished", _run_pick)
