"""Files that are whole or not there: written beside their place, synced, then moved by one atomic step."""

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

_DISK_FULL_MESSAGES = tuple(os.strerror(code) for code in (errno.ENOSPC, errno.EDQUOT))
"""How the system says that more room would help; libraries that write for us pass on its words, not its number."""


class FileWriteError(DualbrainError):
    """A file could not be written; what stood there before stands there still."""

    def __init__(self, path: Path, error: Exception) -> None:
        """Name the path, and the reason by `error`."""
        reason = getattr(error, "strerror", None) or str(error)
        self.path, self.reason = path, reason
        fix = (
            "Free some space."
            if any(words in reason for words in _DISK_FULL_MESSAGES)
            else "Mend that, or name another place."
        )
        super().__init__(f"not written: {reason}. What was there before is unchanged. {fix} {path}")


def require_writable(path: Path) -> None:
    """Make the folder of `path`, and try what `write_durably` will do there; for long work, before it begins.

    Raises `DiskFull` if nothing can be written at `path`.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=path.parent, prefix=f".{path.name}."):
            if path.is_dir():
                raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
    except OSError as error:
        raise FileWriteError(path, error) from error


def write_atomically(path: Path, data: bytes) -> None:
    """Put `data` at `path`. Promise: a reader, or a crash at any moment, finds the old content or the new one, whole.

    Raises `DiskFull` if it cannot be written.
    """
    try:
        descriptor, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
        beside = Path(name)
        try:
            with os.fdopen(descriptor, "wb") as out:
                out.write(data)
                out.flush()
                os.fsync(out.fileno())
            beside.replace(path)
            fsync_folder(path.parent)
        finally:
            beside.unlink(missing_ok=True)
    except OSError as error:
        raise FileWriteError(path, error) from error


@contextmanager
def atomic_file(path: Path) -> Generator[Path]:
    """A name beside `path` for a program that writes files itself; moved to `path` when the body ends well, else gone.

    Who may read it is for the umask to say, as of any file. Raises `DiskFull` for what the body cannot write.
    """
    beside = _temporary_sibling(path)
    try:
        beside.touch(exist_ok=False)
    except OSError as error:
        raise FileWriteError(path, error) from error
    try:
        yield beside
        with beside.open("rb") as written:
            os.fsync(written.fileno())
        beside.replace(path)
        fsync_folder(path.parent)
    except OSError as error:
        raise FileWriteError(path, error) from error
    finally:
        beside.unlink(missing_ok=True)


@contextmanager
def atomic_folder(path: Path) -> Generator[Path]:
    """A new folder beside `path` to put files into; moved to `path` when the body ends well, else gone.

    Who may read it is for the umask to say. Raises `DiskFull` for what the body cannot write, or where files are.
    """
    beside = _temporary_sibling(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        beside.mkdir()
        yield beside
        for file in beside.iterdir():
            with file.open("rb") as written:
                os.fsync(written.fileno())
        fsync_folder(beside)
        beside.rename(path)
        fsync_folder(path.parent)
    except OSError as error:
        raise FileWriteError(path, error) from error
    finally:
        shutil.rmtree(beside, ignore_errors=True)


def _temporary_sibling(path: Path) -> Path:
    """A name in the folder of `path` that nobody else has."""
    return path.with_name(f".{path.name}.{secrets.token_hex(4)}")


def fsync_folder(folder: Path) -> None:
    """Make the names in `folder` last through a loss of power."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
