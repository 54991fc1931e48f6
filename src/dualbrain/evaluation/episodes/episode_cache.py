"""What is alike in every input is flown once: doors that let the same contract through lead to the same episode.

B1, B2 and G differ in their door alone. Where the whole gate accepts the first answer, every door lets the same
contract through, and from there on nothing differs: the episode of one is that of all. Rows are kept in a folder that
many processes may use at once.
"""

from __future__ import annotations

import hashlib
from pathlib import Path

import msgspec

from dualbrain.core.storage.atomic_files import write_atomically
from dualbrain.errors import DECODE_ERRORS
from dualbrain.evaluation.protocol.case import Case
from dualbrain.evaluation.protocol.method import Method
from dualbrain.evaluation.results.episode_row import EpisodeRow


class EpisodeCache:
    """A folder of rows by everything that decides an episode but the door."""

    def __init__(self, folder: Path) -> None:
        """Use `folder`; it is made by the first row."""
        self._folder = folder

    def get(self, case: Case, method: Method, planner: str, key: str) -> EpisodeRow | None:
        """The row `key` of `method` at `case`, from an episode that is like its own; None if there is none.

        `planner` is the id under which its answers are kept.
        """
        path = self._path(case, method, planner)
        if method.uses_memory or not path.exists():
            return None
        try:
            row = msgspec.json.decode(path.read_bytes(), type=EpisodeRow)
        except DECODE_ERRORS:
            return None  # damaged: flown again, and kept anew
        if row.key == key:  # flown before, and killed before it stood in the journal
            return row
        return msgspec.structs.replace(row, key=key, method=method.name, asked=False, same_as=row.key)

    def put(self, case: Case, method: Method, planner: str, row: EpisodeRow) -> None:
        """Keep `row` for other doors, if no door had anything to decide."""
        if not method.uses_memory and row.shots == 1 and not row.first_stage:
            self._folder.mkdir(parents=True, exist_ok=True)
            write_atomically(self._path(case, method, planner), msgspec.json.encode(row))

    def _path(self, case: Case, method: Method, planner: str) -> Path:
        decides = msgspec.json.encode([case.pair, planner, method.guard, method.perception])
        return self._folder / f"{hashlib.sha256(decides).hexdigest()[:32]}.json"
