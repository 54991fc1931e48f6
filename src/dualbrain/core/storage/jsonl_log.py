"""A journal of finished episodes: one JSON line each, on the disk before it counts; a torn last line is not counted."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import msgspec

from dualbrain.errors import UNREADABLE

Line = dict[str, Any]


class Journal:
    """Append-only lines of JSON at `path`; one process writes."""

    def __init__(self, path: Path) -> None:
        """Use `path`; it is made by the first line."""
        self.path = path

    def lines(self) -> list[Line]:
        """Every whole line."""
        return [line for _, line in self.numbered()]

    def numbered(self) -> list[tuple[int, Line]]:
        """Every whole line with its number, as an editor counts."""
        found: list[tuple[int, Line]] = []
        for number, line in enumerate(self.path.read_bytes().splitlines() if self.path.exists() else (), start=1):
            try:
                found.append((number, msgspec.json.decode(line, type=Line)))
            except UNREADABLE:
                continue  # cut off by a kill: its episode is flown again
        return found

    def append(self, line: Line) -> None:
        """Write `line` through to the disk."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        with self.path.open("ab+") as file:
            if file.tell() and not _ends_whole(file):
                file.write(b"\n")
            file.write(msgspec.json.encode(line) + b"\n")
            file.flush()
            os.fsync(file.fileno())


def _ends_whole(file: Any) -> bool:
    file.seek(-1, os.SEEK_END)
    return file.read(1) == b"\n"
