"""Episodes of intervention: stretches of time in which a filter acts or would act, and their file, one line each."""

from __future__ import annotations

from math import inf, isfinite
from os import SEEK_END
from pathlib import Path

import msgspec

from dualbrain.safety.cbf.result import FilterResult, FilterStatus


class InterventionInterval(msgspec.Struct, frozen=True, kw_only=True):
    """One stretch in which the filter's answer differs from the command, on the clock of the caller's `now`.

    `start` and `end` [s] are its first and last changed tick, `ticks` how many changed in between; `peak` is the
    largest delta, at `peak_at` [s]; `cause` took the largest share of the delta; `worst` is the highest status by name;
    `h_min` [m] the least barrier value (None: the input was refused all the time); `words` explain the peak. An episode
    that lasts is told in pieces, all but the last with `goes_on`.
    """

    start: float
    end: float
    ticks: int
    peak: float
    peak_at: float
    cause: str
    worst: str
    h_min: float | None
    words: str
    goes_on: bool = False


class OpenInterval:
    """An episode that may still go on: extended tick by tick, then closed."""

    def __init__(self, now: float) -> None:
        """Begin at `now` [s]."""
        self.start = self.end = self._peak_at = now
        self._ticks, self._peak, self._worst, self._explanation = 0, -1.0, FilterStatus.SAFE, ""
        self._h_min = inf
        self._delta_by_cause: dict[str, float] = {}

    def add(self, now: float, answer: FilterResult, h: float | None, cause: str) -> None:
        """One more changed tick; `h` [m] is None where the input was refused."""
        self.end = now
        self._ticks += 1
        self._worst = max(self._worst, answer.status)
        self._delta_by_cause[cause] = self._delta_by_cause.get(cause, 0.0) + answer.delta
        if h is not None:
            self._h_min = min(self._h_min, h)
        if answer.delta > self._peak:
            self._peak, self._peak_at, self._explanation = answer.delta, now, answer.explain()

    def finish(self, *, continued: bool = False) -> InterventionInterval:
        """The episode as it is told."""
        cause = max(self._delta_by_cause, key=lambda name: self._delta_by_cause[name])
        h_min = self._h_min if isfinite(self._h_min) else None
        return InterventionInterval(
            start=self.start,
            end=self.end,
            ticks=self._ticks,
            peak=self._peak,
            peak_at=self._peak_at,
            cause=cause,
            worst=self._worst.name,
            h_min=h_min,
            words=self._explanation,
            goes_on=continued,
        )


class InterventionLog:
    """A file of episodes: each becomes one line of JSON by one unbuffered write, so that a crash loses none before it.

    What is written survives the death of this process; whether it survives a loss of power is up to the system, because
    waiting for the disk has no place in a control loop. A line that a crash has torn is cut off when the file is opened
    again.
    """

    def __init__(self, path: Path) -> None:
        """Open `path` for appending."""
        self.path = path
        self._file = path.open("ab", buffering=0)
        if torn := _torn_bytes(path):
            self._file.truncate(self._file.seek(0, SEEK_END) - torn)

    def __call__(self, interval: InterventionInterval) -> None:
        """Append one line; raises `OSError` when the disk refuses it."""
        self._file.write(msgspec.json.encode(interval) + b"\n")

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def __enter__(self) -> InterventionLog:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def read_intervention_log(path: Path) -> tuple[InterventionInterval, ...]:
    """Every whole line of a file of episodes, also of one that is still being written."""
    whole = path.read_bytes().rpartition(b"\n")[0]
    return tuple(msgspec.json.decode(line, type=InterventionInterval) for line in whole.splitlines())


def _torn_bytes(path: Path) -> int:
    """Bytes behind the last line break."""
    return len(path.read_bytes().rpartition(b"\n")[2])
