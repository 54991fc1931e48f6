"""Cache of episodes that have the same inputs for several methods.

B1, B2 and G differ only in their gates. If the full gate accepts the first answer, all three gates accept the same
contract, and everything after that is the same: one episode serves all of them. Rows are stored in a folder that
several processes may use at once.
"""

from __future__ import annotations

import hashlib
from pathlib import Path

import msgspec

from dualbrain.core.storage.atomic_files import write_atomically
from dualbrain.core.storage.private_files import create_private_folder
from dualbrain.errors import DECODE_ERRORS
from dualbrain.evaluation.protocol.case import Case
from dualbrain.evaluation.protocol.method import Method
from dualbrain.evaluation.results.episode_row import EpisodeRow


class EpisodeCache:
    """A folder of rows, by hash of everything that determines an episode except the method's gate."""

    def __init__(self, folder: Path) -> None:
        """Use `folder`, which need not exist."""
        self._folder = folder

    def get(self, case: Case, method: Method, planner: str, key: str) -> EpisodeRow | None:
        """The row `key` of `method` for `case`, from an episode with the same inputs; None if there is none.

        `planner` is the planner's id in the cache of answers.
        """
        path = self._path(case, method, planner)
        if method.uses_memory or not path.exists():
            return None
        try:
            row = msgspec.json.decode(path.read_bytes(), type=EpisodeRow)
        except DECODE_ERRORS:
            return None  # damaged: the episode is run and stored again
        if row.key == key:  # the run was killed between this cache and the log
            return row
        return msgspec.structs.replace(row, key=key, method=method.name, asked=False, same_as=row.key)

    def put(self, case: Case, method: Method, planner: str, row: EpisodeRow) -> None:
        """Store `row` for the methods with other gates, if the full gate accepted its first answer."""
        if not method.uses_memory and row.shots == 1 and not row.first_stage:
            create_private_folder(self._folder)
            write_atomically(self._path(case, method, planner), msgspec.json.encode(row))

    def _path(self, case: Case, method: Method, planner: str) -> Path:
        inputs = msgspec.json.encode([case.pair, planner, method.guard, method.perception])
        return self._folder / f"{hashlib.sha256(inputs).hexdigest()[:32]}.json"
