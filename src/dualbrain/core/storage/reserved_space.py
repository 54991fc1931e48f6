"""Disk space that is reserved before a robot moves, so that the files of its end fit on a disk that fills up meanwhile.

The space belongs to a temporary file without a name, which the operating system deletes when its process ends for any
reason. Assumption: the file system keeps allocated blocks for a file (a compressing one may not), and no other process
takes the space between its release and the write that needs it.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Generator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO

from dualbrain.core.storage.atomic_files import write_remedy
from dualbrain.errors import ConfigurationError

BLOCK_BYTES = 1 << 20
"""Block [bytes] in which the space is written where it cannot be allocated at once."""


class ReservedSpace:
    """`size` bytes on the disk of `folder`; `is_held` until they are released."""

    def __init__(self, folder: Path, size: int, purpose: str) -> None:
        """Reserve `size` [bytes] in `folder`, which exists, for `purpose`, named in the error.

        Raises `ConfigurationError` if the space cannot be reserved.
        """
        self.folder, self.size = folder, size
        self._file: IO[bytes] | None = None
        try:
            self._file = _allocate(folder, size)
        except OSError as error:
            raise ConfigurationError.stating(
                f"{size / 1e6:.0f} MB for {purpose} cannot be reserved in the folder {folder}: "
                f"{error.strerror or error}.",
                fix=write_remedy(error),
            ) from error

    @property
    def is_held(self) -> bool:
        """Whether the space is reserved."""
        return self._file is not None

    def release(self) -> bool:
        """Free the space for the next write; returns whether it was reserved. May be called repeatedly."""
        file, self._file = self._file, None
        if file is None:
            return False
        with suppress(OSError):  # an error of the disk while it closes the file: the space is free in any case
            file.close()
        return True

    @contextmanager
    def lent(self) -> Generator[None]:
        """Free the space for the writes of the body, and reserve it again afterwards as far as there is room."""
        was_held = self.release()
        try:
            yield
        finally:
            if was_held:
                with suppress(OSError):
                    self._file = _allocate(self.folder, self.size)


def _allocate(folder: Path, size: int) -> IO[bytes]:
    """An open file without a name that occupies `size` bytes."""
    file = tempfile.TemporaryFile(dir=folder)  # noqa: SIM115  (it stays open)
    try:
        if hasattr(os, "posix_fallocate"):
            os.posix_fallocate(file.fileno(), 0, size)
        else:
            for start in range(0, size, BLOCK_BYTES):
                file.write(bytes(min(BLOCK_BYTES, size - start)))
            file.flush()
    except BaseException:
        file.close()
        raise
    return file
