"""The file of a recording: every byte is either written or kept, also when the disk is full.

Data is collected in memory and written by `flush`. If a write fails, the failure is reported and the reserved space is
released for the rest of the recording; what still cannot be written stays in memory for the next attempt.
"""

from __future__ import annotations

import errno
import os
from pathlib import Path

from dualbrain.core.storage.atomic_files import FileWriteError, write_remedy
from dualbrain.core.storage.private_files import open_private
from dualbrain.core.storage.reserved_space import ReservedSpace
from dualbrain.errors import ConfigurationError

RECORDING_RESERVE = 8_000_000
"""Space [bytes] that is reserved for the end of a recording, about half a minute of it."""


def reserve_for_recording(path: Path, *, unrecorded: bool) -> ReservedSpace | None:
    """The reserved space for the recording `path`; with `unrecorded`, None if there is no room for it.

    Raises `ConfigurationError` if the space cannot be reserved.
    """
    try:
        return ReservedSpace(path.parent, RECORDING_RESERVE, "the end of the recording")
    except ConfigurationError:
        if unrecorded:
            return None
        raise


class RecordingFile:
    """A binary file to append to; `failure` states the first failed write, "" if there is none."""

    def __init__(self, path: Path, reserve: ReservedSpace | None = None) -> None:
        """Create the file; `reserve` is released when a write fails. Raises `FileWriteError`."""
        self.path, self.failure = path, ""
        self._reserve, self._unwritten, self._end = reserve, bytearray(), 0
        try:
            with open_private(path, "wb", buffering=0) as file:
                self._descriptor = os.dup(file.fileno())
        except OSError as error:
            if reserve is not None:
                reserve.release()
            raise FileWriteError(path, error) from error

    def write(self, data: bytes) -> int:
        """Append `data` in memory; returns its length."""
        self._unwritten += data
        self._end += len(data)
        return len(data)

    def tell(self) -> int:
        """The length of the file with everything that was appended [bytes]."""
        return self._end

    def flush(self) -> None:
        """Write everything to the disk. Raises `OSError` if that fails in spite of the reserved space."""
        try:
            self._write_out()
        except OSError as error:
            reason = error.strerror or str(error)
            sentence = f"The recording {self.path} cannot be written: {reason}. {write_remedy(error)}"
            self.failure = self.failure or sentence
            if self._reserve is None or not self._reserve.release():
                raise
            self._write_out()

    def close(self) -> None:
        """Write the rest, close the file, and release the reserved space. Raises `OSError`."""
        try:
            self.flush()
        finally:
            os.close(self._descriptor)
            if self._reserve is not None:
                self._reserve.release()

    def _write_out(self) -> None:
        if not os.fstat(self._descriptor).st_nlink:
            raise FileNotFoundError(errno.ENOENT, "the file was deleted")
        while self._unwritten:
            del self._unwritten[: os.write(self._descriptor, self._unwritten)]
