"""Finds the Python interpreters in which a release is checked."""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

VERSIONS = ("3.11", "3.12", "3.13")
"""Versions of CPython that a release must work with."""
INSTALL_HINT = (
    "Install it so that `python{version}` is on PATH: with the packages of your system, `uv python install {version}`, "
    "or `pyenv install {version}`."
)


class MissingInterpreterError(Exception):
    """A version of Python that is not on this machine."""

    def __init__(self, versions: tuple[str, ...]) -> None:
        """Report the missing `versions` and how to get each."""
        self.versions = versions
        super().__init__(
            " ".join(f"Python {version} was not found. {INSTALL_HINT.format(version=version)}" for version in versions)
        )


def find_interpreters(versions: tuple[str, ...] = VERSIONS, *, allow_missing: bool = False) -> dict[str, Path]:
    """The interpreter of each version, by version; a missing one is left out if `allow_missing`.

    Raises:
        MissingInterpreterError: At least one version is missing, and that is not allowed.
    """
    found = {version: find_interpreter(version) for version in versions}
    missing = tuple(version for version, path in found.items() if path is None)
    if missing and not allow_missing:
        raise MissingInterpreterError(missing)
    return {version: path for version, path in found.items() if path is not None}


def find_interpreter(version: str) -> Path | None:
    """The first interpreter of `version` that runs: on PATH, of pyenv, or of uv; None if there is none."""
    return next((path for path in _candidates(version) if _runs(path, version)), None)


def _candidates(version: str) -> Iterator[Path]:
    if on_path := shutil.which(f"python{version}"):
        yield Path(on_path)
    pyenv = Path(os.environ.get("PYENV_ROOT") or Path.home() / ".pyenv") / "versions"
    yield from sorted(pyenv.glob(f"{version}.*/bin/python3"), reverse=True)
    data = Path(os.environ.get("XDG_DATA_HOME") or Path.home() / ".local" / "share")
    yield from sorted((data / "uv" / "python").glob(f"cpython-{version}.*/bin/python3"), reverse=True)


def _runs(path: Path, version: str) -> bool:
    """Whether the program at `path` is CPython `version`; a shim of pyenv may name a version that is not active."""
    code = "import sys; print(sys.implementation.name, '%d.%d' % sys.version_info[:2])"
    try:
        done = subprocess.run([path, "-c", code], capture_output=True, text=True, timeout=30, check=False)
    except OSError:
        return False
    return done.stdout.split() == ["cpython", version]
