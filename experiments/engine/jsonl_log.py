"""The journal of a proof: one JSON row a finished unit, on disk before the next one starts."""

from __future__ import annotations

import json
import lzma
import os
from pathlib import Path

from experiments.engine.experiment import Row


class JsonlLog:
    """Appends rows to a JSONL file and reads them back; a line that was cut by a kill is ignored and done again."""

    def __init__(self, path: Path) -> None:
        """The file need not exist."""
        self.path = path

    def rows(self) -> list[Row]:
        """The last whole row of each key, in order of first appearance."""
        latest: dict[str, Row] = {}
        for line in self.path.read_bytes().splitlines() if self.path.exists() else ():
            try:
                row = json.loads(line)
            except ValueError:
                continue
            latest[row["key"]] = row
        return list(latest.values())

    def finished_keys(self) -> set[str]:
        """Keys that need not be done again: all but those whose last row is an error."""
        return {row["key"] for row in self.rows() if "error" not in row}

    def append(self, row: Row) -> None:
        """Write `row` through to the disk."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        with self.path.open("ab+") as file:
            if file.tell() and not self._ends_with_newline(file):
                file.write(b"\n")
            file.write(json.dumps(row, separators=(",", ":"), default=float).encode() + b"\n")
            file.flush()
            os.fsync(file.fileno())

    def restore_from(self, kept: Path) -> None:
        """Start with what `kept` holds, packed by xz, if that exists and this file does not."""
        if kept.exists() and not self.path.exists():
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self.path.write_bytes(lzma.decompress(kept.read_bytes()))

    def pack_to(self, kept: Path) -> None:
        """Write the last row of each unit to `kept`, packed by xz, in place of what is there: answers are alike."""
        lines = [json.dumps(row, separators=(",", ":")) + "\n" for row in self.rows()]
        kept.parent.mkdir(parents=True, exist_ok=True)
        kept.write_bytes(lzma.compress("".join(lines).encode(), preset=9))

    @staticmethod
    def _ends_with_newline(file) -> bool:
        """Whether the file ends with a whole line."""
        file.seek(-1, os.SEEK_END)
        return file.read(1) == b"\n"
