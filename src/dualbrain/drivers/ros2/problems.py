"""Problems of the node's inputs, with the levels of `diagnostic_msgs`, collected between two diagnostic messages."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum


class Level(IntEnum):
    """Level of a diagnostic status, with the numbers of `diagnostic_msgs/DiagnosticStatus`."""

    OK = 0
    WARN = 1
    ERROR = 2
    STALE = 3


@dataclass(frozen=True, slots=True)
class Problem:
    """A problem: its level, and a sentence that states cause and remedy."""

    level: Level
    text: str


class ProblemLog:
    """The problems since the last diagnostic message, each text once, in the order of their first occurrence."""

    def __init__(self) -> None:
        """Begin without a problem."""
        self._counts: dict[str, int] = {}
        self._problems: dict[str, Problem] = {}

    def note(self, level: Level, kind: str, text: str) -> None:
        """Note one occurrence of a problem; of each `kind` the last text is kept."""
        self._counts[kind] = self._counts.get(kind, 0) + 1
        self._problems[kind] = Problem(level, text)

    def take(self) -> list[tuple[Problem, int]]:
        """The problems and how often each occurred, an error first; the log is empty afterwards.

        ERROR counts as worse than STALE, so that a cause is stated before its consequence.
        """
        order = {Level.ERROR: 0, Level.STALE: 1, Level.WARN: 2, Level.OK: 3}
        found = [(problem, self._counts[kind]) for kind, problem in self._problems.items()]
        self._counts, self._problems = {}, {}
        return sorted(found, key=lambda one: order[one[0].level])
