"""Files and folders that only their user can open: folders 0700 and files 0600, with every umask.

Runs, ledgers, recordings, data sets and keys contain instructions and images of a user, so every file that dualbrain
creates in a data or run folder is created here or by `atomic_files.write_atomically`. Files that a user exports for
others follow the umask instead (`atomic_file`, `atomic_folder`).
"""

from __future__ import annotations

import os
import stat
from collections.abc import Generator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO, Literal

from dualbrain.core.storage.atomic_files import atomic_file, atomic_folder
from dualbrain.errors import ConfigurationError

FILE_MODE, FOLDER_MODE = 0o600, 0o700
OTHERS = 0o077
"""Permission bits of all users but the owner."""
_FLAGS = {
    "wb": os.O_WRONLY | os.O_CREAT | os.O_TRUNC,
    "xb": os.O_WRONLY | os.O_CREAT | os.O_EXCL,
    "ab": os.O_WRONLY | os.O_CREAT | os.O_APPEND,
    "a+b": os.O_RDWR | os.O_CREAT | os.O_APPEND,
}


def create_private_folder(path: Path) -> None:
    """Create the folder `path` and its missing parents with mode 0700; an existing folder is left as it is.

    Raises `OSError` if that fails, for example `FileExistsError` if `path` is a file.
    """
    missing = [path]
    while not missing[-1].parent.exists() and missing[-1].parent != missing[-1]:
        missing.append(missing[-1].parent)
    for folder in reversed(missing):
        try:
            folder.mkdir(mode=FOLDER_MODE)
        except FileExistsError:
            if not folder.is_dir():
                raise
        else:
            folder.chmod(FOLDER_MODE)


def open_private_folder(path: Path) -> None:
    """Create `path` like `create_private_folder`, and set an existing folder of this user to mode 0700.

    For folders that contain only files of dualbrain, such as its data folder and run folders. Raises `OSError`.
    """
    create_private_folder(path)
    tighten(path)


def tighten(path: Path) -> None:
    """Take all permissions of other users from the file or folder `path`, if this user owns it.

    Links are not followed, and a folder that users share (sticky bit, such as /tmp) stays as it is. Does nothing if
    there is no such file. Raises `OSError` if the permissions cannot be changed.
    """
    flags = os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
    with suppress(FileNotFoundError):
        found = path.lstat()
        if not (stat.S_ISREG(found.st_mode) or stat.S_ISDIR(found.st_mode)) or not _can_be_tightened(found):
            return
        descriptor = os.open(path, flags)
        try:
            _tighten_descriptor(descriptor)
        finally:
            os.close(descriptor)


def open_private(path: Path, mode: Literal["wb", "xb", "ab", "a+b"], *, buffering: int = -1) -> BinaryIO:
    """Open the file `path` for writing, with mode 0600 from its creation on; an existing file of this user gets it too.

    `mode` and `buffering` are those of `open`. Raises `OSError`.
    """
    descriptor = os.open(path, _FLAGS[mode] | os.O_CLOEXEC, FILE_MODE)
    try:
        found = os.fstat(descriptor)
        if stat.S_ISREG(found.st_mode) and found.st_uid == os.geteuid() and stat.S_IMODE(found.st_mode) != FILE_MODE:
            os.fchmod(descriptor, FILE_MODE)
        return os.fdopen(descriptor, mode, buffering)  # pyright: ignore[reportReturnType]
    except BaseException:
        with suppress(OSError):
            os.close(descriptor)
        raise


@contextmanager
def private_file(path: Path) -> Generator[Path]:
    """An `atomic_file` with mode 0600."""
    with atomic_file(path) as temporary:
        temporary.chmod(FILE_MODE)
        yield temporary
        temporary.chmod(FILE_MODE)


@contextmanager
def private_folder(path: Path) -> Generator[Path]:
    """An `atomic_folder` with mode 0700, whose files have mode 0600."""
    create_private_folder(path.parent)
    with atomic_folder(path) as temporary:
        temporary.chmod(FOLDER_MODE)
        yield temporary
        for entry in temporary.iterdir():
            tighten(entry)


def refuse_special_file(path: Path, what: str) -> None:
    """Raise `ConfigurationError` if `path` is a link or anything else but a regular file.

    `what` names the file in the message, such as "write-ahead log of the memory ledger". A missing file is accepted.
    """
    try:
        found = path.lstat()
    except FileNotFoundError:
        return
    if not stat.S_ISREG(found.st_mode):
        raise ConfigurationError.stating(
            f"The {what} is {describe_kind(found.st_mode)} and not a regular file.",
            fix=f"dualbrain never creates one there: find out who did, then remove it. {path}",
        )


def describe_kind(mode: int) -> str:
    """The kind of a file with the mode `mode` (`st_mode`), with its article."""
    kinds = {
        stat.S_IFREG: "a regular file",
        stat.S_IFDIR: "a folder",
        stat.S_IFLNK: "a symbolic link",
        stat.S_IFIFO: "a named pipe",
        stat.S_IFSOCK: "a socket",
        stat.S_IFCHR: "a device",
        stat.S_IFBLK: "a device",
    }
    return kinds.get(stat.S_IFMT(mode), "a special file")


def _can_be_tightened(found: os.stat_result) -> bool:
    is_shared = stat.S_ISDIR(found.st_mode) and found.st_mode & stat.S_ISVTX
    return bool(found.st_mode & OTHERS) and found.st_uid == os.geteuid() and not is_shared


def _tighten_descriptor(descriptor: int) -> None:
    found = os.fstat(descriptor)
    if (stat.S_ISREG(found.st_mode) or stat.S_ISDIR(found.st_mode)) and _can_be_tightened(found):
        os.fchmod(descriptor, stat.S_IMODE(found.st_mode) & ~OTHERS)
