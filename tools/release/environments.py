"""Virtual environments outside the checkout, and programs that run in them."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
"""The checkout."""
INHERITED_SETTINGS = ("PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV", "DUALBRAIN_HOME")
"""Variables of the caller that would change a check."""
BUNDLED = {"pip", "setuptools", "wheel"}
"""Distributions that a new environment has already."""


class ProgramError(Exception):
    """A program of the release check that failed."""

    def __init__(self, command: list[str], output: str) -> None:
        """Report the command and the end of its output."""
        super().__init__(f"{' '.join(command)} failed:\n{output[-4000:]}")


def run_program(
    command: list[str | Path],
    *,
    cwd: Path | None = None,
    settings: Mapping[str, str] | None = None,
    limit_s: int = 1800,
) -> str:
    """Standard output of `command`, which runs in `cwd` with additional environment variables.

    Raises `ProgramError` if it fails.
    """
    words = [str(word) for word in command]
    inherited = {name: value for name, value in os.environ.items() if name not in INHERITED_SETTINGS}
    environ = {**inherited, "PIP_CONSTRAINT": str(ROOT / "constraints.txt"), **(settings or {})}
    done = subprocess.run(words, cwd=cwd, env=environ, capture_output=True, text=True, timeout=limit_s, check=False)
    if done.returncode:
        raise ProgramError(words, done.stdout + done.stderr)
    return done.stdout


@dataclass(frozen=True, slots=True)
class Environment:
    """A virtual environment in `folder`."""

    folder: Path

    @property
    def python(self) -> Path:
        """Its interpreter."""
        return self.program("python")

    def program(self, name: str) -> Path:
        """Path of a program that is installed in it."""
        return self.folder / "bin" / name

    def install(self, *requirements: str) -> float:
        """Install `requirements` with the pinned versions, and return the time it took [s]."""
        begun = time.perf_counter()
        run_program([self.python, "-m", "pip", "install", "--quiet", *requirements], cwd=self.folder)
        return time.perf_counter() - begun

    def packages(self) -> tuple[str, ...]:
        """Names of the installed distributions, without those of a new environment."""
        listed = json.loads(run_program([self.python, "-m", "pip", "list", "--format", "json"], cwd=self.folder))
        return tuple(sorted({str(one["name"]) for one in listed} - BUNDLED))

    def size_bytes(self) -> int:
        """Size of its packages on the disk [bytes], without those of a new environment."""
        (packages,) = (self.folder / "lib").glob("python*/site-packages")
        parts = (part for part in packages.iterdir() if part.name.partition("-")[0] not in {*BUNDLED, "pkg_resources"})
        return sum(_size(part) for part in parts)


def create_environment(folder: Path, interpreter: Path) -> Environment:
    """A new, empty environment of `interpreter` in `folder`; an older one there is deleted."""
    shutil.rmtree(folder, ignore_errors=True)
    run_program([interpreter, "-m", "venv", folder])
    return Environment(folder)


def _size(path: Path) -> int:
    files = path.rglob("*") if path.is_dir() else (path,)
    return sum(file.lstat().st_size for file in files if not file.is_dir())
