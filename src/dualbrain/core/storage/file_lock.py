"""One writer at a time: an advisory lock beside the ledger that says who holds it and dies with its holder."""

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
    """Who holds the lock: process id, what it is doing, and since when [s, 1970 UTC]."""

    pid: int
    name: str
    since: float


class LedgerInUseError(DualbrainError):
    """Another process writes this ledger."""

    def __init__(self, holder: LockHolder | None, path: str) -> None:
        """Name the holder (None if it has not yet said who it is) and, last, the ledger."""
        self.holder, self.path = holder, path
        who = "another process" if holder is None else f"process {holder.pid} ({holder.name})"
        super().__init__(
            f"The memory ledger is being written by {who}. One writer at a time: wait for it, stop it, "
            f"or give this run a ledger of its own with --ledger FILE. Reading is always allowed. {path}"
        )


POLL_INTERVAL_S = 0.02
"""Pause between two attempts to take the lock [s]."""


class WriterLock:
    """An exclusive `flock` on `<ledger>.lock`.

    The operating system drops it when the holder ends, however it ends, so a killed run leaves no stale lock behind.
    Assumption: a local file system (network file systems may not honour `flock`).
    """

    def __init__(self, ledger: Path, holder: LockHolder, *, timeout_s: float = 0.0) -> None:
        """Take the lock, trying for about `patience` [s], or raise `LedgerInUse`."""
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
        """Let go although the buffered words could not be written."""
        with contextlib.suppress(OSError):
            self._file.close()

    def release(self) -> None:
        """Let the next writer in; the file stays, empty."""
        if not self._file.closed:
            self._file.truncate(0)
            self._file.close()


def current_holder(ledger: Path) -> LockHolder | None:
    """Who writes `ledger`, None if nobody does; takes no lock, so that nobody is kept out by being looked at.

    Holders write themselves into the file and empty it when they let go; one that was killed counts as gone.
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
    except PermissionError:  # somebody else's
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
