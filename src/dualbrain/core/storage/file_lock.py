"""Locks between processes; the operating system releases a lock when its holder ends for any reason."""

from __future__ import annotations

from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path

from filelock import FileLock, Timeout

from dualbrain.core.storage.private_files import FILE_MODE
from dualbrain.errors import DualbrainError

POLL_INTERVAL_S = 0.02
"""Pause between two attempts to take a lock [s]."""


class LockedError(DualbrainError):
    """Another process holds a lock."""

    def __init__(self, path: Path) -> None:
        """Report the lock file."""
        self.path = path
        super().__init__(f"Another process holds the lock {path}.")


@contextmanager
def file_lock(path: Path, *, timeout_s: float | None = None) -> Generator[None]:
    """Hold the lock file `path` exclusively while the body runs, and wait for it for `timeout_s` [s] (None: forever).

    The lock file remains on the disk. Assumption: a local file system (network file systems may not honour `flock`).

    Raises:
        LockedError: Another process still holds the lock after `timeout_s`.
    """
    lock = FileLock(path, timeout=-1 if timeout_s is None else timeout_s, mode=FILE_MODE, poll_interval=POLL_INTERVAL_S)
    try:
        lock.acquire()
    except Timeout as error:
        raise LockedError(path) from error
    try:
        yield
    finally:
        lock.release()
