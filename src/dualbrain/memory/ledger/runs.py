"""What a run leaves in the ledger, and the words for one that was cut off."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime

import msgspec

from dualbrain.errors import DECODE_ERRORS
from dualbrain.memory.ledger.hash_chain import LedgerEvent

STARTED, MARKED, ENDED, INTERRUPTED = "run_started", "run_marked", "run_ended", "run_interrupted"
"""Kinds of the events that frame a run; `run_interrupted` is written by the next run, in place of `run_ended`."""


@dataclass(frozen=True, slots=True, kw_only=True)
class InterruptedRun:
    """A run that began and never ended: killed, crashed or without power. Times [s] since 1970 UTC.

    `last_words` is what the run last said it was doing; `episodes` counts those it had stored.
    """

    run: str
    started: float
    last_time: float
    last_activity: str
    episodes: int

    def __str__(self) -> str:
        """One sentence for a person."""
        stored = "1 episode was" if self.episodes == 1 else f"{self.episodes} episodes were"
        return (
            f"Run {self.run} of {_utc(self.started)} was interrupted after {self.last_activity} "
            f"({_utc(self.last_time)}): {stored} stored and kept; what was under way then is not in memory."
        )


def describe_activity(event: LedgerEvent) -> str:
    """What a run was doing when it wrote `event`, its last one."""
    if event.kind == MARKED:
        try:
            return repr(msgspec.json.decode(event.payload, type=_RunMarker).what)
        except DECODE_ERRORS:
            return "a mark that cannot be read"
    return {STARTED: "its start", "episode": f"storing episode {event.subject}"}.get(event.kind, event.kind)


class _RunMarker(msgspec.Struct):
    what: str


def _utc(time: float) -> str:
    return datetime.fromtimestamp(time, UTC).strftime("%Y-%m-%d %H:%M:%S UTC")
