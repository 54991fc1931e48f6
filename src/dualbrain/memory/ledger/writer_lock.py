"""Writer lock of a ledger: an advisory lock file that names its holder and is released when the holder ends."""

from __future__ import annotations

import os
from contextlib import ExitStack
from pathlib import Path

import msgspec

from dualbrain.core.storage.file_lock import LockedError, file_lock
from dualbrain.errors import DECODE_ERRORS, DualbrainError


class LockHolder(msgspec.Struct, frozen=True):
    """Holder of the lock: process id, name of its work, and the time since when [s, since 1970 UTC]."""

    pid: int
    name: str
    since: float


class LedgerInUseError(DualbrainError):
    """Another process writes this ledger."""

    def __init__(self, holder: LockHolder | None, path: str) -> None:
        """Report the holder (None if it has not yet written its name) and, last, the ledger."""
        self.holder, self.path = holder, path
        who = "another process" if holder is None else f"process {holder.pid} ({holder.name})"
        super().__init__(
            f"The memory ledger is being written by {who}. Only one process may write it: wait for that process, stop "
            f"it, or use another ledger with --ledger FILE. Reading is always allowed. {path}"
        )


class WriterLock:
    """Exclusive lock `<ledger>.lock`; the lock file contains the holder as JSON while the lock is held.

    A killed writer leaves no stale lock (see `file_lock`).
    """

    def __init__(self, ledger: Path, holder: LockHolder, *, timeout_s: float = 0.0) -> None:
        """Take the lock within `timeout_s` [s], or raise `LedgerInUseError`; a full disk raises `OSError`."""
        self._path = _lock_path(ledger)
        with ExitStack() as stack:
            try:
                stack.enter_context(file_lock(self._path, timeout_s=timeout_s))
            except LockedError as error:
                raise LedgerInUseError(_read_holder(self._path), str(ledger)) from error
            _write_holder(self._path, msgspec.json.encode(holder))
            self._held, self._released = stack.pop_all(), False

    def release(self) -> None:
        """Release the lock; the empty lock file remains. A second call does nothing."""
        if not self._released:
            self._released = True
            with self._held:
                _write_holder(self._path, b"")


def current_holder(ledger: Path) -> LockHolder | None:
    """The process that writes `ledger`, None if there is none; takes no lock, so that it delays no writer.

    A holder writes its name into the lock file and empties the file on release; a killed holder does not count.
    """
    holder = _read_holder(_lock_path(ledger))
    return holder if holder is not None and _is_alive(holder.pid) else None


def _lock_path(ledger: Path) -> Path:
    return ledger.with_name(ledger.name + ".lock")


def _is_alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:  # the process belongs to another user
        return True
    return True


def _write_holder(path: Path, encoded: bytes) -> None:
    with path.open("r+b") as file:  # not replaced: the lock is held on this file
        file.truncate(0)
        file.write(encoded)
        file.flush()
        os.fsync(file.fileno())


def _read_holder(path: Path) -> LockHolder | None:
    try:
        return msgspec.json.decode(path.read_bytes(), type=LockHolder)
    except (OSError, *DECODE_ERRORS):
        return None
