"""Writer lock of a ledger: an advisory lock file that names its holder and is released when the holder ends."""

from __future__ import annotations

import contextlib
import fcntl
import os
import time
from pathlib import Path
from typing import BinaryIO

import msgspec

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


POLL_INTERVAL_S = 0.02
"""Pause between two attempts to take the lock [s]."""


class WriterLock:
    """An exclusive `flock` on `<ledger>.lock`.

    The operating system releases the lock when the holder ends for any reason, so a killed run leaves no stale lock.
    Assumption: a local file system (network file systems may not honour `flock`).
    """

    def __init__(self, ledger: Path, holder: LockHolder, *, timeout_s: float = 0.0) -> None:
        """Take the lock, retrying for about `timeout_s` [s], or raise `LedgerInUseError`."""
        path = ledger.with_name(ledger.name + ".lock")
        self._file: BinaryIO = path.open("a+b")
        attempts = 1 + round(timeout_s / POLL_INTERVAL_S)
        while not _try_lock(self._file):
            attempts -= 1
            if not attempts:
                other = _decode_holder(self._file)
                self._file.close()
                raise LedgerInUseError(other, str(ledger))
            time.sleep(POLL_INTERVAL_S)
        try:
            self._file.truncate(0)
            self._file.write(msgspec.json.encode(holder))
            self._file.flush()
            os.fsync(self._file.fileno())
        except OSError:  # a full disk
            self._close_unwritten()
            raise

    def _close_unwritten(self) -> None:
        """Close the file although its buffer could not be written."""
        with contextlib.suppress(OSError):
            self._file.close()

    def release(self) -> None:
        """Release the lock; the empty lock file remains."""
        if not self._file.closed:
            self._file.truncate(0)
            self._file.close()


def current_holder(ledger: Path) -> LockHolder | None:
    """The process that writes `ledger`, None if there is none; takes no lock, so that it delays no writer.

    A holder writes its name into the lock file and empties the file on release; a killed holder does not count.
    """
    try:
        with ledger.with_name(ledger.name + ".lock").open("rb") as file:
            holder = _decode_holder(file)
    except OSError:
        return None
    return holder if holder is not None and _is_alive(holder.pid) else None


def _is_alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:  # the process belongs to another user
        return True
    return True


def _try_lock(file: BinaryIO) -> bool:
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


def _decode_holder(file: BinaryIO) -> LockHolder | None:
    file.seek(0)
    try:
        return msgspec.json.decode(file.read(), type=LockHolder)
    except DECODE_ERRORS:
        return None
