"""Files that are whole or not there: written beside their place, synced, then moved by one atomic step."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

from dualbrain.errors import DualbrainError


class DiskFull(DualbrainError):
    """A file could not be written; what stood there before stands there still."""

    def __init__(self, path: Path, reason: str) -> None:
        """Name the reason and the path."""
        self.path, self.reason = path, reason
        super().__init__(f"not written: {reason}. What was there before is unchanged. Free some space. {path}")


def write_durably(path: Path, data: bytes) -> None:
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
            sync_folder(path.parent)
        finally:
            beside.unlink(missing_ok=True)
    except OSError as error:
        raise DiskFull(path, error.strerror or str(error)) from error


def sync_folder(folder: Path) -> None:
    """Make the names in `folder` last through a loss of power."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
