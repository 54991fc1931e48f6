"""Long work in steps: each leaves a whole folder, so that work that was stopped goes on where it was."""

from __future__ import annotations

import fcntl
import shutil
from collections.abc import Callable, Generator
from contextlib import contextmanager
from pathlib import Path

from dualbrain.errors import InvalidSetup


def carry_on(folder: Path, steps: int, do: Callable[[int, Path], None], *, start: Path | None = None) -> Path:
    """Do what is left of `steps` steps in `folder`; returns the folder that the last one left.

    `do(number, here)` works in a copy of what the step before left, or of `start`, or in an empty folder. Only whole
    steps count: one that was killed, or raised, is done again from its beginning. Another process that wants the same
    steps waits for them.
    """
    with alone(folder):
        last = left_by_steps(folder)
        for number in range(_number(last), steps):
            partial = folder / "partial"
            shutil.rmtree(partial, ignore_errors=True)
            before = last or start
            shutil.copytree(before, partial) if before else partial.mkdir()
            do(number, partial)
            last = partial.rename(folder / f"step-{number + 1:04d}")
        for old in folder.glob("step-*"):
            if old != last:
                shutil.rmtree(old)
    assert last is not None, "work has at least one step"
    return last


def left_by_steps(folder: Path) -> Path | None:
    """What the last whole step in `folder` left, None before the first."""
    return max(folder.glob("step-*"), default=None)


@contextmanager
def alone(folder: Path, *, wait: bool = True) -> Generator[None]:
    """Nobody else works in `folder` meanwhile; whoever wants to waits. It is made, and is free again after a kill.

    Without `wait` it raises `InvalidSetup` instead.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / "lock").open("w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
        except BlockingIOError as error:
            fix = f"Wait until it is done, stop it, or name another folder. {folder}"
            raise InvalidSetup("folder", got="another process works in it", allowed="one at a time", fix=fix) from error
        yield


def _number(last: Path | None) -> int:
    """How many steps are done."""
    return int(last.name.removeprefix("step-")) if last else 0
