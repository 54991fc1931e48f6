"""Temporary folder with the socket and the keys of a gatekeeper that a program starts for itself.

The program removes it at its end. A killed one cannot, so the next program removes the folders of ended ones: an owner
holds a lock on a file in its folder, which the operating system releases when the owner ends for any reason.
"""

from __future__ import annotations

import fcntl
import os
import shutil
import stat
import tempfile
from collections.abc import Generator
from contextlib import contextmanager, suppress
from pathlib import Path

from dualbrain.control.gatekeeper.protocol.server import is_listening
from dualbrain.core.storage.private_files import FILE_MODE

SOCKET_NAME, KEYS_NAME = "socket", "keys"
"""Names in the folder."""
_PREFIX, _OWNER_NAME, _NEW_OWNER_NAME = "dualbrain-", "owner.lock", "owner.new"


@contextmanager
def socket_folder() -> Generator[Path]:
    """A new folder while the body runs; the folders of killed programs of this user are removed first."""
    remove_abandoned_folders(Path(tempfile.gettempdir()))
    with tempfile.TemporaryDirectory(prefix=_PREFIX) as name, _owned(Path(name)):
        yield Path(name)


def remove_abandoned_folders(parent: Path) -> None:
    """Remove the folders in `parent` whose owner has ended; one that cannot be removed stays.

    A folder stays too while a gatekeeper listens at its socket: it ends within 5 s after its program.
    """
    for folder in parent.glob(f"{_PREFIX}*"):
        with suppress(OSError):
            if _is_own_folder(folder):
                _remove_if_abandoned(folder)


@contextmanager
def _owned(folder: Path) -> Generator[None]:
    """Hold the lock of `folder`; the file gets its name with the lock, so no other program sees it without."""
    descriptor = os.open(folder / _NEW_OWNER_NAME, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, FILE_MODE)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        (folder / _NEW_OWNER_NAME).rename(folder / _OWNER_NAME)
        yield
    finally:
        os.close(descriptor)


def _is_own_folder(path: Path) -> bool:
    found = path.lstat()
    return stat.S_ISDIR(found.st_mode) and found.st_uid == os.getuid()


def _remove_if_abandoned(folder: Path) -> None:
    """Remove `folder` unless its owner lives; raises `OSError`, also if it is not a folder of `socket_folder`."""
    descriptor = os.open(folder / _OWNER_NAME, os.O_RDWR | os.O_NOFOLLOW | os.O_CLOEXEC)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        if not is_listening(folder / SOCKET_NAME):
            shutil.rmtree(folder)
    finally:
        os.close(descriptor)
