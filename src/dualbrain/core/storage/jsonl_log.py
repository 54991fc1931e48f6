"""Append-only JSONL log: every line is synced to the disk, and lines that cannot be decoded are skipped."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import msgspec

from dualbrain.errors import DECODE_ERRORS

JsonlLine = dict[str, Any]


class JsonlLog:
    """Append-only JSONL file at `path`, written by one process."""

    def __init__(self, path: Path) -> None:
        """Use `path`; the first `append` creates the file."""
        self.path = path

    def read(self) -> list[JsonlLine]:
        """Every complete line."""
        return [line for _, line in self.read_numbered()]

    def read_numbered(self) -> list[tuple[int, JsonlLine]]:
        """Every complete line with its line number (from 1)."""
        found: list[tuple[int, JsonlLine]] = []
        for number, line in enumerate(self.path.read_bytes().splitlines() if self.path.exists() else (), start=1):
            try:
                found.append((number, msgspec.json.decode(line, type=JsonlLine)))
            except DECODE_ERRORS:
                continue  # a line that was cut off when the process was killed
        return found

    def append(self, line: JsonlLine) -> None:
        """Append `line` and sync the file to the disk."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        with self.path.open("ab+") as file:
            if _is_cut_off(file):
                file.write(b"\n")
            file.write(msgspec.json.encode(line) + b"\n")
            file.flush()
            os.fsync(file.fileno())


def _is_cut_off(file: Any) -> bool:
    """Whether `file` is not empty and does not end with a newline."""
    if file.seek(0, os.SEEK_END) == 0:
        return False
    file.seek(-1, os.SEEK_END)
    return file.read(1) != b"\n"
