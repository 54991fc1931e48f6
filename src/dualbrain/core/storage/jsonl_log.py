"""JSONL logs of finished work: one JSON object per line, on disk before `append` returns.

A line that was cut off by a kill is ignored when the log is read, so its work is done again. Non-finite numbers are
written as `NaN` and `Infinity`, as Python's `json` reads them.
"""

from __future__ import annotations

import json
import lzma
import os
from pathlib import Path
from typing import Any, BinaryIO

from dualbrain.core.storage.atomic_files import atomic_file, fsync_folder
from dualbrain.core.storage.private_files import create_private_folder, open_private, private_file

JsonlLine = dict[str, Any]

XZ_PRESET = 9


class JsonlLog:
    """Append-only log of JSON objects at `path`, written by one process."""

    def __init__(self, path: Path) -> None:
        """Use `path`, which need not exist: the first `append` creates it."""
        self.path = path

    def read(self) -> list[JsonlLine]:
        """Every complete line."""
        return [line for _, line in self.read_numbered()]

    def read_numbered(self) -> list[tuple[int, JsonlLine]]:
        """Every complete line with its line number, counted from 1."""
        found: list[tuple[int, JsonlLine]] = []
        for number, data in enumerate(self.path.read_bytes().splitlines() if self.path.exists() else (), start=1):
            line = _parse(data)
            if line is not None:
                found.append((number, line))
        return found

    def latest(self) -> list[JsonlLine]:
        """The last complete line of each `key`, in the order in which the keys first appear."""
        return list({line["key"]: line for line in self.read()}.values())

    def finished_keys(self) -> set[str]:
        """Keys whose last line reports no `error`; the work of all other keys is to be done (again)."""
        return {line["key"] for line in self.latest() if "error" not in line}

    def append(self, line: JsonlLine) -> None:
        """Write `line` through to the disk; with the first one also the entries of the file and of new folders."""
        folder = self.path.parent
        new_folders = [one for one in (folder, *folder.parents) if not one.exists()]
        create_private_folder(folder)
        with open_private(self.path, "a+b") as file:
            is_first = not file.tell()
            if not is_first and not _ends_with_newline(file):
                file.write(b"\n")
            file.write(encode_line(line))
            file.flush()
            os.fsync(file.fileno())
        if is_first:
            for changed in (folder, *(one.parent for one in new_folders)):
                fsync_folder(changed)

    def pack_to(self, archive: Path) -> None:
        """Write the last line of each key to `archive`, compressed by xz; replaces an existing archive.

        Raises `FileWriteError` if the archive cannot be written; the previous archive is then unchanged.
        """
        archive.parent.mkdir(parents=True, exist_ok=True)
        data = lzma.compress(b"".join(map(encode_line, self.latest())), preset=XZ_PRESET)
        with atomic_file(archive) as temporary:
            temporary.write_bytes(data)

    def restore_from(self, archive: Path) -> None:
        """Start from the lines in `archive`, if it exists and this log does not."""
        if archive.exists() and not self.path.exists():
            create_private_folder(self.path.parent)
            with private_file(self.path) as temporary:
                temporary.write_bytes(lzma.decompress(archive.read_bytes()))


def _parse(data: bytes) -> JsonlLine | None:
    """The object in one line, None if the line is incomplete or holds no object."""
    try:
        line = json.loads(data)
    except (ValueError, RecursionError):  # invalid JSON or UTF-8, unlimited nesting
        return None
    return line if isinstance(line, dict) else None


def encode_line(line: JsonlLine) -> bytes:
    """One line; NumPy's scalars are written as floats."""
    return json.dumps(line, separators=(",", ":"), default=float).encode() + b"\n"


def _ends_with_newline(file: BinaryIO) -> bool:
    file.seek(-1, os.SEEK_END)
    return file.read(1) == b"\n"
