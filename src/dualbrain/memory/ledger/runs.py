"""Ledger events that begin and end a run, and the description of an interrupted run."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime

import msgspec

from dualbrain.errors import DECODE_ERRORS
from dualbrain.memory.ledger.hash_chain import LedgerEvent

STARTED, MARKED, ENDED, INTERRUPTED = "run_started", "run_marked", "run_ended", "run_interrupted"
"""Kinds of events of a run; the next run writes `run_interrupted` in place of a missing `run_ended`."""


@dataclass(frozen=True, slots=True, kw_only=True)
class InterruptedRun:
    """A run that began and never ended, because it was killed, crashed or lost power. Times in s since 1970 UTC.

    `last_activity` is the last step that the run recorded; `episodes` is the number of episodes that it stored.
    """

    run: str
    started: float
    last_time: float
    last_activity: str
    episodes: int

    def __str__(self) -> str:
        """One sentence for people."""
        stored = "1 episode was" if self.episodes == 1 else f"{self.episodes} episodes were"
        return (
            f"Run {self.run} of {_utc(self.started)} was interrupted after {self.last_activity} "
            f"({_utc(self.last_time)}): {stored} stored and kept; an unfinished episode is not in memory."
        )


def describe_activity(event: LedgerEvent) -> str:
    """The activity of a run at its last event `event`."""
    if event.kind == MARKED:
        try:
            return repr(msgspec.json.decode(event.payload, type=_RunMarker).what)
        except DECODE_ERRORS:
            return "a step that cannot be read"
    return {STARTED: "its start", "episode": f"storing episode {event.subject}"}.get(event.kind, event.kind)


class _RunMarker(msgspec.Struct):
    what: str


def _utc(time: float) -> str:
    return datetime.fromtimestamp(time, UTC).strftime("%Y-%m-%d %H:%M:%S UTC")
