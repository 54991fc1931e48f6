"""Registration of running gatekeepers: one small file per process, so that `dualbrain doctor` can list them.

The file is deleted when the gatekeeper ends. One that a killed gatekeeper left is recognized by the start time of its
process, because the operating system uses process numbers again.
"""

from __future__ import annotations

import os
from collections.abc import Generator
from contextlib import contextmanager, suppress
from pathlib import Path

import msgspec

from dualbrain.core.storage.atomic_files import FileWriteError, write_atomically
from dualbrain.core.storage.private_files import create_private_folder
from dualbrain.errors import DECODE_ERRORS

REGISTRATIONS = "gatekeepers"
"""Folder of the registrations in the data folder of dualbrain."""
SUFFIX = ".json"


class Registration(msgspec.Struct, frozen=True, kw_only=True):
    """A running gatekeeper: its process, the robot, the files of its socket and keys, and what started it.

    `start_ticks` is the start of the process in clock ticks since the start of the machine, None where the operating
    system does not report it.
    """

    pid: int
    start_ticks: int | None
    robot: str
    socket: str
    keys: str
    started_by: str

    @property
    def is_running(self) -> bool:
        """Whether the process that wrote this still runs."""
        if self.start_ticks is not None:
            return process_start_ticks(self.pid) == self.start_ticks
        with suppress(OSError):
            os.kill(self.pid, 0)
            return True
        return False


@contextmanager
def registered(folder: Path | None, *, robot: str, socket: str, keys: str, started_by: str) -> Generator[None]:
    """Register this process in `folder` while the body runs (None: do not).

    A gatekeeper whose folder cannot be written runs without registration: its process still has the robot and the
    socket on its command line.
    """
    pid = os.getpid()
    if folder is None:
        yield
        return
    path = folder / f"{pid}{SUFFIX}"
    registration = Registration(
        pid=pid,
        start_ticks=process_start_ticks(pid),
        robot=robot,
        socket=str(Path(socket).absolute()),
        keys=str(Path(keys).absolute()),
        started_by=started_by,
    )
    with suppress(OSError, FileWriteError):
        create_private_folder(folder)
        _remove_stale_files(folder)
        write_atomically(path, msgspec.json.encode(registration))
    try:
        yield
    finally:
        with suppress(OSError):
            path.unlink(missing_ok=True)


def read_registrations(folder: Path) -> list[Registration]:
    """The registrations of processes that still run; unreadable files and those of ended processes are left out."""
    found = (_read(path) for path in sorted(folder.glob(f"*{SUFFIX}")))
    return [one for one in found if one is not None and one.is_running]


def process_start_ticks(pid: int) -> int | None:
    """Start of the process `pid` in clock ticks since the start of the machine; None if it does not run (any more)."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8", errors="replace").rpartition(")")[2].split()
    except OSError:
        return None
    return None if fields[0] in ("Z", "X") else int(fields[19])


def _read(path: Path) -> Registration | None:
    with suppress(OSError, *DECODE_ERRORS):
        return msgspec.json.decode(path.read_bytes(), type=Registration)
    return None


def _remove_stale_files(folder: Path) -> None:
    for path in folder.glob(f"*{SUFFIX}"):
        one = _read(path)
        if one is None or not one.is_running:
            path.unlink(missing_ok=True)
