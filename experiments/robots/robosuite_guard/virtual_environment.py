"""The virtual environment of robosuite with dualbrain, build/robosuite_guard/venv, created from requirements.txt.

Run: python -m experiments.robots.robosuite_guard.virtual_environment

dualbrain is built and installed from this checkout, and again when its sources change.
"""

from __future__ import annotations

import hashlib
from pathlib import Path

from experiments.engine.virtual_environment import BUILD, VirtualEnvironment, run_creation

ROOT = Path(__file__).resolve().parents[3]
REQUIREMENTS = Path(__file__).resolve().parent / "requirements.txt"
SOURCES = ("src", "kernel", "CMakeLists.txt", "pyproject.toml")
"""The files and folders from which dualbrain is built."""
ENVIRONMENT = VirtualEnvironment(
    title="robosuite with dualbrain",
    folder=BUILD / "robosuite_guard",
    command="python -m experiments.robots.robosuite_guard.virtual_environment",
    sources=(REQUIREMENTS,),
)


def create() -> Path:
    """Create the environment if it does not exist, and bring dualbrain up to date; returns its interpreter.

    Raises:
        MissingDependencyError: pip could not install it; the output of pip is on stderr.
    """
    python = ENVIRONMENT.create(_install_suite)
    mark, digest = ENVIRONMENT.folder / "dualbrain-made-from", _source_digest()
    if not mark.exists() or mark.read_text() != digest:
        ENVIRONMENT.pip("install", str(ROOT))  # a folder is installed again although its version is there
        mark.write_text(digest)
    return python


def _install_suite() -> None:
    numpy = next(package for package in ENVIRONMENT.packages if package.startswith("numpy=="))
    ENVIRONMENT.pip("install", *(package for package in ENVIRONMENT.packages if package != numpy))
    ENVIRONMENT.pip("install", numpy)
    (ENVIRONMENT.folder / "dualbrain-made-from").unlink(missing_ok=True)


def _source_digest() -> str:
    found = hashlib.sha256()
    for name in SOURCES:
        path = ROOT / name
        for file in sorted(path.rglob("*")) if path.is_dir() else [path]:
            if file.is_file() and "__pycache__" not in file.parts:
                found.update(file.relative_to(ROOT).as_posix().encode() + file.read_bytes())
    return found.hexdigest()[:12]


if __name__ == "__main__":
    run_creation(create)
