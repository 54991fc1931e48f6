"""Reading of a file that may be hostile: a regular file, of at most a given number of bytes.

A path may name a device without an end (/dev/zero), a pipe that waits for ever, or a file that grows while it is read.
The kind of the file is checked before it is opened, because opening a device can have effects, and again afterwards;
reading stops one byte above the limit.
"""

from __future__ import annotations

import os
import stat
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, Literal

from dualbrain.errors import ConfigurationError

_OPEN_FLAGS = os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC | os.O_NOCTTY
_READ_SIZE = 1 << 20
_KINDS = (
    (stat.S_ISDIR, "a folder"),
    (stat.S_ISFIFO, "a named pipe"),
    (stat.S_ISSOCK, "a socket"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
    (stat.S_ISLNK, "a symbolic link"),
)


@dataclass(frozen=True, slots=True)
class FileRefusal:
    """A file that was not read: a full sentence about the problem, and the remedy."""

    kind: Literal["missing", "not regular", "too large", "unreadable"]
    sentence: str
    fix: str


def read_regular_file(path: Path, limit: int, *, follow_links: bool = True) -> bytes | FileRefusal:
    """The content of the regular file `path`, of at most `limit` bytes, or a refusal; never waits.

    Symbolic links are followed, unless `follow_links` is False: then the last part of the path must not be one.
    """
    try:
        if refusal := _refusal_of_kind(path, os.stat(path, follow_symlinks=follow_links).st_mode):
            return refusal
        handle = os.open(path, _OPEN_FLAGS | (0 if follow_links else os.O_NOFOLLOW))
        try:
            state = os.fstat(handle)
            if refusal := _refusal_of_kind(path, state.st_mode):
                return refusal
            data = b"" if state.st_size > limit else _read_at_most(handle, limit + 1)
        finally:
            os.close(handle)
    except (FileNotFoundError, NotADirectoryError):
        return FileRefusal("missing", f"There is no file {path}.", "Check the path.")
    except (OSError, ValueError) as error:  # ValueError: a NUL character in the path
        reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
        return FileRefusal("unreadable", f"The file {path} cannot be read ({reason}).", "Check its permissions.")
    if state.st_size > limit or len(data) > limit:
        return FileRefusal(
            "too large", f"The file {path} is larger than {byte_size(limit)}.", "Use a smaller file, or split it."
        )
    return data


def read_bounded_file(path: Path, limit: int, *, fix: str = "") -> bytes:
    """The content of the regular file `path`, of at most `limit` bytes; `fix` replaces the general remedy.

    Raises `ConfigurationError` if there is no such file, or it is not regular, too large or unreadable.
    """
    found = read_regular_file(path, limit)
    if isinstance(found, FileRefusal):
        raise ConfigurationError.stating(found.sentence, fix=fix or found.fix)
    return found


def read_bounded_stream(stream: BinaryIO, limit: int, name: str) -> bytes:
    """All bytes of a `stream` called `name` (such as stdin); raises `ConfigurationError` above `limit` bytes."""
    parts: list[bytes] = []
    left = limit + 1
    while left and (part := stream.read(min(left, _READ_SIZE))):
        parts.append(part)
        left -= len(part)
    if not left:
        raise ConfigurationError.stating(f"The input {name} is larger than {byte_size(limit)}.", fix="Send less.")
    return b"".join(parts)


def byte_size(count: int) -> str:
    """`count` bytes in words: "512 MB", "64 kB", "100 bytes" (1 MB is 2**20 bytes)."""
    for unit, size in (("MB", 1 << 20), ("kB", 1 << 10)):
        if count >= size and count % size == 0:
            return f"{count // size} {unit}"
    return f"{count} bytes"


def _refusal_of_kind(path: Path, mode: int) -> FileRefusal | None:
    if stat.S_ISREG(mode):
        return None
    kind = next((name for matches, name in _KINDS if matches(mode)), "a special file")
    return FileRefusal("not regular", f"{path} is {kind}, not a regular file.", "Name a regular file.")


def _read_at_most(handle: int, count: int) -> bytes:
    parts: list[bytes] = []
    while count and (part := os.read(handle, min(count, _READ_SIZE))):
        parts.append(part)
        count -= len(part)
    return b"".join(parts)
