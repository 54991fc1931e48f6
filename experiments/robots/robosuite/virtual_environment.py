"""The suite's own environment, build/outsider/venv, made from requirements.txt.

Run: python experiments/robots/robosuite/virtual_environment.py

Installs robosuite 1.5.2, MuJoCo 3.3.7 and NumPy 1.26.4 with what they need (1.3 GB on disk) and nothing of dualbrain.
What is done is not done again: the environment carries the digest of the requirements that it was made from.
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
COMMAND = "python experiments/robots/robosuite/virtual_environment.py"


def requirements_digest() -> str:
    """What the environment is to be made from, 12 hex."""
    return hashlib.sha256(REQUIREMENTS.read_bytes()).hexdigest()[:12]


def interpreter(folder: Path = ENVIRONMENT_FOLDER) -> Path:
    """The interpreter of the environment below `folder`; raises `MissingPart` unless it is there as wanted now."""
    mark, python = folder / "made-from", folder / "venv" / "bin" / "python"
    if not (mark.exists() and mark.read_text() == requirements_digest() and python.exists()):
        raise MissingDependencyError(
            "the environment of robosuite", fix=f"Make it: `{COMMAND}` (needs a package index)."
        )
    return python


def create(folder: Path = ENVIRONMENT_FOLDER) -> Path:
    """Make the environment below `folder` if it is not there; its interpreter.

    Raises:
        MissingPart: pip could not install it; what pip said stands on stderr.
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
            fix="pip could not install it; its words stand above. Is there an index?",
        )
    (folder / "made-from").write_text(requirements_digest())
    return python


def required_packages() -> list[str]:
    """The packages that are named, with their versions."""
    return [line for line in REQUIREMENTS.read_text().splitlines() if line and not line.startswith("#")]


if __name__ == "__main__":
    try:
        create()
    except MissingDependencyError as missing:
        sys.exit(str(missing))
