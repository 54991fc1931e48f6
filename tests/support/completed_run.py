"""One finished run of the command line, shared by all tests that only look at what it left."""

import os
import subprocess
import sys

from tests.stories.story_session import GRASP, PLACE, contract
from tests.support.run_once import once

RUN = "import sys; from dualbrain.cli.main import call; sys.exit(call(sys.argv[1:]))"


def command(folder, *arguments, **environment):
    """`dualbrain ARGUMENTS` in a process of its own, at home in `folder`."""
    home = {"DUALBRAIN_HOME": str(folder), "COLUMNS": "500"}
    return subprocess.run(
        [sys.executable, "-c", RUN, *arguments], cwd=folder, env={**os.environ, **home, **environment},
        capture_output=True, text=True, check=False,
    )  # fmt: skip


def _pick(folder):
    (folder / "pick.json").write_text(contract(("grasp", GRASP), ("place", PLACE)))
    done = command(
        folder, "run", "put the red cube in the bowl", "--contract", "pick.json", "--headless", "--json",
        "--scene", "bare:0", "--out", "run",
    )  # fmt: skip
    return done.returncode, done.stdout, done.stderr


def finished(factory):
    """(folder, exit code, stdout, stderr) of a pick and place on the bare scene; the run folder is folder/run."""
    return once(factory, "finished", _pick)
