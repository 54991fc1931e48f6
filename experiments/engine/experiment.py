"""What a proof is: units of work by key, what one unit leaves, and the tables that are read at the end."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

Row = dict[str, Any]
"""What one unit leaves, as JSON: at least `key`; `error` if it broke instead of ending."""


@dataclass(frozen=True, slots=True)
class WorkUnit:
    """One piece of work: its `key` in the journal, and what it is `about` (JSON)."""

    key: str
    parameters: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Options:
    """What all proofs share: the `folder` of the journals and the `planner` that is asked."""

    folder: Path
    planner: str


class Experiment(Protocol):
    """One claim with its evidence."""

    name: str
    claim: str

    def units(self, options: Options) -> list[WorkUnit]:
        """All the work, most telling first: any prefix is an honest sample."""
        ...

    def run(self, about: dict[str, Any]) -> Row:
        """Do one unit, in a process of its own that may do many."""
        ...

    def summarize_row(self, row: Row) -> str:
        """One row in a few words, for the progress line."""
        ...

    def report(self, rows: list[Row]) -> list[str]:
        """Tables and exceptions as lines of markdown."""
        ...
