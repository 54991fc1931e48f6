"""Resumable work in steps: every completed step leaves a folder, and interrupted work continues from the last one."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Generator
from contextlib import contextmanager
from pathlib import Path

from dualbrain.core.storage.atomic_files import fsync_folder, fsync_tree
from dualbrain.core.storage.file_lock import LockedError, file_lock
from dualbrain.core.storage.private_files import create_private_folder
from dualbrain.errors import ConfigurationError


def run_steps(
    folder: Path, steps: int, run_step: Callable[[int, Path], None], *, initial_folder: Path | None = None
) -> Path:
    """Run the remaining steps of `steps` in `folder` and return the folder of the last step.

    `run_step(number, here)` works in the folder `here`: a copy of the folder of the previous step, or of
    `initial_folder`, or an empty folder. A step that was killed or raised an exception is run again from its
    beginning. The files of a step are on the disk before it counts as completed. Another process that runs the same
    steps waits until they are done.
    """
    with exclusive_folder(folder):
        last = last_step_folder(folder)
        for number in range(_n_completed(last), steps):
            partial = folder / "partial"
            shutil.rmtree(partial, ignore_errors=True)
            before = last or initial_folder
            shutil.copytree(before, partial) if before else create_private_folder(partial)
            run_step(number, partial)
            fsync_tree(partial)
            last = partial.rename(folder / f"step-{number + 1:04d}")
            fsync_folder(folder)
        for old in folder.glob("step-*"):
            if old != last:
                shutil.rmtree(old)
    assert last is not None, "work has at least one step"
    return last


def last_step_folder(folder: Path) -> Path | None:
    """The folder of the last completed step in `folder`, None before the first."""
    return max(folder.glob("step-*"), default=None)


@contextmanager
def exclusive_folder(folder: Path, *, wait: bool = True) -> Generator[None]:
    """Exclusive use of `folder`, which is created; other processes wait. The lock ends with the process.

    Raises:
        ConfigurationError: Another process uses the folder and `wait` is False.
    """
    create_private_folder(folder)
    try:
        with file_lock(folder / "lock", timeout_s=None if wait else 0.0):
            yield
    except LockedError as error:
        fix = f"Wait until it is done, stop it, or use another folder. {folder}"
        raise ConfigurationError.stating("Another process works in this folder.", fix=fix) from error


def _n_completed(last: Path | None) -> int:
    """Number of completed steps."""
    return int(last.name.removeprefix("step-")) if last else 0
