"""Intervals of intervention, in which a filter acts or would act, and their JSON Lines log."""

from __future__ import annotations

from errno import ENOSPC
from math import inf, isfinite
from os import SEEK_END
from pathlib import Path

import msgspec

from dualbrain.core.storage.private_files import open_private
from dualbrain.safety.cbf.result import FilterResult, FilterStatus


class InterventionInterval(msgspec.Struct, frozen=True, kw_only=True):
    """One interval in which the filter's result differs from the command, on the clock of the caller's `now`.

    `start` and `end` [s] are the first and last changed tick, `ticks` is the number of changed ticks. `peak` is the
    largest delta, at `peak_at` [s]. `cause` has the largest share of the sum of delta. `worst` is the name of the
    highest status. `h_min` [m] is the smallest barrier value (None: every input was rejected). `words` explains the
    peak. A long interval is reported in pieces; all but the last have `goes_on`.
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
    """An interval that is not finished: extended tick by tick, then closed."""

    def __init__(self, now: float) -> None:
        """Start the interval at `now` [s]."""
        self.start = self.end = self._peak_at = now
        self._ticks, self._peak, self._worst, self._explanation = 0, -1.0, FilterStatus.SAFE, ""
        self._h_min = inf
        self._delta_by_cause: dict[str, float] = {}

    def add(self, now: float, result: FilterResult, h: float | None, cause: str) -> None:
        """Add a changed tick at `now` [s]; `h` [m] is None if the filter rejected the input."""
        self.end = now
        self._ticks += 1
        self._worst = max(self._worst, result.status)
        self._delta_by_cause[cause] = self._delta_by_cause.get(cause, 0.0) + result.delta
        if h is not None:
            self._h_min = min(self._h_min, h)
        if result.delta > self._peak:
            self._peak, self._peak_at, self._explanation = result.delta, now, result.explain()

    def finish(self, *, continued: bool = False) -> InterventionInterval:
        """The finished interval; `continued` if the next piece follows."""
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
    """JSON Lines file of intervals: one unbuffered write per line, so that a crash does not lose earlier lines.

    Written lines survive the end of this process. The operating system decides whether they survive a power failure,
    because a control loop must not wait for the disk. Opening the file removes an incomplete last line.
    """

    def __init__(self, path: Path) -> None:
        """Open `path` for appending; raises `OSError` if that fails."""
        self.path = path
        self._file = open_private(path, "ab", buffering=0)
        if torn := _torn_bytes(path):
            self._file.truncate(self._file.seek(0, SEEK_END) - torn)

    def __call__(self, interval: InterventionInterval) -> None:
        """Append one line; raises `OSError` if the write fails. A line that the disk takes in part is removed."""
        line = msgspec.json.encode(interval) + b"\n"
        size = self._file.seek(0, SEEK_END)
        if self._file.write(line) != len(line):
            self._file.truncate(size)
            raise OSError(ENOSPC, "the disk took only a part of the line", str(self.path))

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def __enter__(self) -> InterventionLog:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def read_intervention_log(path: Path) -> tuple[InterventionInterval, ...]:
    """All complete lines of a log; the log may still be open for writing."""
    whole = path.read_bytes().rpartition(b"\n")[0]
    return tuple(msgspec.json.decode(line, type=InterventionInterval) for line in whole.splitlines())


def _torn_bytes(path: Path) -> int:
    """Number of bytes after the last line break."""
    return len(path.read_bytes().rpartition(b"\n")[2])
