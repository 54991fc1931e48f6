"""The suite's virtual environment, build/robosuite/venv, created from requirements.txt.

Run: python -m experiments.robots.robosuite.virtual_environment

It installs robosuite 1.5.2, MuJoCo 3.3.7 and NumPy 1.26.4 with their dependencies (1.3 GB on disk), without dualbrain.
An existing environment is used again if it was created from the same requirements, which a digest records.
"""

from __future__ import annotations

import hashlib
import subprocess
import sys
import venv
from pathlib import Path

from dualbrain.errors import MissingDependencyError

HERE = Path(__file__).resolve().parent
ENVIRONMENT_FOLDER = HERE.parents[2] / "build" / "robosuite"
REQUIREMENTS = HERE / "requirements.txt"
COMMAND = "python -m experiments.robots.robosuite.virtual_environment"


def requirements_digest() -> str:
    """Digest of the requirements, 12 hex digits."""
    return hashlib.sha256(REQUIREMENTS.read_bytes()).hexdigest()[:12]


def interpreter(folder: Path = ENVIRONMENT_FOLDER) -> Path:
    """The interpreter of the environment in `folder`.

    Raises `MissingDependencyError` unless it exists and was created from the present requirements.
    """
    mark, python = folder / "made-from", folder / "venv" / "bin" / "python"
    if not (mark.exists() and mark.read_text() == requirements_digest() and python.exists()):
        fix = f"Create it with `{COMMAND}` (needs a package index)."
        raise MissingDependencyError("The virtual environment of robosuite", fix=fix)
    return python


def create(folder: Path = ENVIRONMENT_FOLDER) -> Path:
    """Create the environment in `folder` if it does not exist; returns its interpreter.

    Raises:
        MissingDependencyError: pip could not install it; the output of pip is on stderr.
    """
    try:
        return interpreter(folder)
    except MissingDependencyError:
        print(f"installing into {folder.name}/venv: {', '.join(required_packages())}", file=sys.stderr)
    venv.create(folder / "venv", with_pip=True, clear=True)
    python = folder / "venv" / "bin" / "python"
    command = [str(python), "-m", "pip", "install", "--quiet", "-r", str(REQUIREMENTS)]
    if subprocess.run(command, check=False, stdout=sys.stderr).returncode != 0:
        raise MissingDependencyError(
            f"robosuite ({', '.join(required_packages())})",
            fix="pip could not install it (see its output above); check that a package index is reachable.",
        )
    (folder / "made-from").write_text(requirements_digest())
    return python


def required_packages() -> list[str]:
    """The required packages with their versions."""
    return [line for line in REQUIREMENTS.read_text().splitlines() if line and not line.startswith("#")]


if __name__ == "__main__":
    try:
        create()
    except MissingDependencyError as missing:
        sys.exit(str(missing))
