"""Long work in steps: each leaves a whole folder, so that work that was stopped goes on where it was."""

from __future__ import annotations

import fcntl
import shutil
from collections.abc import Callable, Generator
from contextlib import contextmanager
from pathlib import Path

from dualbrain.errors import ConfigurationError


def run_steps(
    folder: Path, steps: int, run_step: Callable[[int, Path], None], *, initial_folder: Path | None = None
) -> Path:
    """Do what is left of `steps` steps in `folder`; returns the folder that the last one left.

    `do(number, here)` works in a copy of what the step before left, or of `start`, or in an empty folder. Only whole
    steps count: one that was killed, or raised, is done again from its beginning. Another process that wants the same
    steps waits for them.
    """
    with exclusive_folder(folder):
        last = last_step_folder(folder)
        for number in range(_n_completed(last), steps):
            partial = folder / "partial"
            shutil.rmtree(partial, ignore_errors=True)
            before = last or initial_folder
            shutil.copytree(before, partial) if before else partial.mkdir()
            run_step(number, partial)
            last = partial.rename(folder / f"step-{number + 1:04d}")
        for old in folder.glob("step-*"):
            if old != last:
                shutil.rmtree(old)
    assert last is not None, "work has at least one step"
    return last


def last_step_folder(folder: Path) -> Path | None:
    """What the last whole step in `folder` left, None before the first."""
    return max(folder.glob("step-*"), default=None)


@contextmanager
def exclusive_folder(folder: Path, *, wait: bool = True) -> Generator[None]:
    """Nobody else works in `folder` meanwhile; whoever wants to waits. It is made, and is free again after a kill.

    Without `wait` it raises `InvalidSetup` instead.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / "lock").open("w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
        except BlockingIOError as error:
            fix = f"Wait until it is done, stop it, or name another folder. {folder}"
            raise ConfigurationError(
                "folder", got="another process works in it", allowed="one at a time", fix=fix
            ) from error
        yield


def _n_completed(last: Path | None) -> int:
    """How many steps are done."""
    return int(last.name.removeprefix("step-")) if last else 0
