"""Atomic writes: a file or folder is written under a temporary name, synced, and renamed in one atomic step."""

from __future__ import annotations

import errno
import os
import secrets
import shutil
import tempfile
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path

from dualbrain.errors import DualbrainError

WRITE_REMEDIES = {
    errno.ENOSPC: "Free some space.",
    errno.EDQUOT: "Free some space, or raise the quota of this user.",
    errno.EFBIG: "Raise the limit on the size of files (`ulimit -f`).",
    errno.EROFS: "Mount its disk for writing, or give another path.",
    errno.EIO: "Check its disk, which reports errors, or give another path.",
}
"""Remedy of a failed write by error number."""


class FileWriteError(DualbrainError):
    """A file or folder that could not be written; the previous content is unchanged, unless it `is_replaced`."""

    def __init__(self, path: Path, error: Exception, *, is_replaced: bool = False) -> None:
        """Report the path and the reason that `error` gives.

        `is_replaced` states that the new content is at `path`, but may be lost in a power failure.
        """
        reason = getattr(error, "strerror", None) or str(error)
        self.path, self.reason, self.remedy, self.is_replaced = path, reason, write_remedy(error), is_replaced
        outcome = (
            f"{path} has its new content, but a power failure may undo this: its folder was not synced: {reason}."
            if is_replaced
            else f"{path} was not written: {reason}. The previous content is unchanged."
        )
        super().__init__(f"{outcome} {self.remedy}")


def write_remedy(error: Exception) -> str:
    """The remedy of a failed write."""
    return disk_remedy(error) or "Fix this, or give another path."


def disk_remedy(error: Exception) -> str:
    """The remedy of an error of `WRITE_REMEDIES`, "" for any other one.

    Some libraries report only the system's message, without the error number.
    """
    number, text = getattr(error, "errno", None), str(error)
    return next((remedy for code, remedy in WRITE_REMEDIES.items() if code == number or os.strerror(code) in text), "")


@contextmanager
def translated_write_errors(path: Path) -> Generator[None]:
    """In the body, every `OSError` becomes a `FileWriteError` that names `path`."""
    try:
        yield
    except OSError as error:
        raise FileWriteError(path, error) from error


def require_writable(path: Path) -> None:
    """Create the folder of `path` and check that a file can be written there, before long work begins.

    Raises `FileWriteError` if no file can be written at `path`.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=path.parent, prefix=f".{path.name}."):
            if path.is_dir():
                raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
    except OSError as error:
        raise FileWriteError(path, error) from error


def write_atomically(path: Path, data: bytes, *, private: bool = True) -> None:
    """Write `data` to `path`. Promise: readers, also after a crash at any moment, find the whole old or new content.

    Only the user may read the file; if it is not `private`, its permissions follow the umask. Raises `FileWriteError`
    if the file cannot be written, or if its new content may be lost in a power failure.
    """
    if not private:
        with atomic_file(path) as sibling:
            sibling.write_bytes(data)
        return
    try:
        descriptor, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
        temporary = Path(name)
        try:
            with os.fdopen(descriptor, "wb") as out:
                out.write(data)
                out.flush()
                os.fsync(out.fileno())
            temporary.replace(path)
            fsync_entry(path)
        finally:
            temporary.unlink(missing_ok=True)
    except OSError as error:
        raise FileWriteError(path, error) from error


@contextmanager
def atomic_file(path: Path) -> Generator[Path]:
    """A temporary file beside `path` for code that writes files itself.

    The file is renamed to `path` if the body ends without an exception, and is deleted otherwise. Its permissions
    follow the umask. Raises `FileWriteError` for every `OSError`, also of the body.
    """
    temporary = _temporary_sibling(path)
    try:
        temporary.touch(exist_ok=False)
    except OSError as error:
        raise FileWriteError(path, error) from error
    try:
        yield temporary
        with temporary.open("rb") as written:
            os.fsync(written.fileno())
        temporary.replace(path)
        fsync_entry(path)
    except OSError as error:
        raise FileWriteError(path, error) from error
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def atomic_folder(path: Path) -> Generator[Path]:
    """A temporary folder beside `path`, renamed to `path` if the body ends without an exception, deleted otherwise.

    Its permissions follow the umask. Raises `FileWriteError` for every `OSError`, also of the body, and if `path` is a
    file or a folder with files.
    """
    temporary = _temporary_sibling(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary.mkdir()
        yield temporary
        fsync_tree(temporary)
        temporary.rename(path)
        fsync_entry(path)
    except OSError as error:
        raise FileWriteError(path, error) from error
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def fsync_tree(folder: Path) -> None:
    """Sync all files and folders in `folder`, and itself, to the disk."""
    for entry in folder.iterdir():
        if entry.is_dir():
            fsync_tree(entry)
            continue
        with entry.open("rb") as written:
            os.fsync(written.fileno())
    fsync_folder(folder)


def _temporary_sibling(path: Path) -> Path:
    """An unused name in the folder of `path`."""
    return path.with_name(f".{path.name}.{secrets.token_hex(4)}")


def fsync_entry(path: Path) -> None:
    """Sync the entry of `path` after a rename. Raises `FileWriteError`, which states that the content is replaced."""
    try:
        fsync_folder(path.parent)
    except OSError as error:
        raise FileWriteError(path, error, is_replaced=True) from error


def fsync_folder(folder: Path) -> None:
    """Sync the directory entries of `folder` to the disk, so that they survive a power failure."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
