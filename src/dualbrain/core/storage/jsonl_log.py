"""A journal of finished episodes: one JSON line each, on the disk before it counts; a torn last line is not counted."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import msgspec

from dualbrain.errors import DECODE_ERRORS

JsonlLine = dict[str, Any]


class JsonlLog:
    """Append-only lines of JSON at `path`; one process writes."""

    def __init__(self, path: Path) -> None:
        """Use `path`; it is made by the first line."""
        self.path = path

    def read(self) -> list[JsonlLine]:
        """Every whole line."""
        return [line for _, line in self.read_numbered()]

    def read_numbered(self) -> list[tuple[int, JsonlLine]]:
        """Every whole line with its number, as an editor counts."""
        found: list[tuple[int, JsonlLine]] = []
        for number, line in enumerate(self.path.read_bytes().splitlines() if self.path.exists() else (), start=1):
            try:
                found.append((number, msgspec.json.decode(line, type=JsonlLine)))
            except DECODE_ERRORS:
                continue  # cut off by a kill: its episode is flown again
        return found

    def append(self, line: JsonlLine) -> None:
        """Write `line` through to the disk."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        with self.path.open("ab+") as file:
            if file.tell() and not _ends_with_newline(file):
                file.write(b"\n")
            file.write(msgspec.json.encode(line) + b"\n")
            file.flush()
            os.fsync(file.fileno())


def _ends_with_newline(file: Any) -> bool:
    file.seek(-1, os.SEEK_END)
    return file.read(1) == b"\n"
