"""How punctual the control tick is: intervals, work and latency of every tick, as conditions and as histograms."""

from __future__ import annotations

from collections import deque

import msgspec

from dualbrain.control.gatekeeper.timing.histogram import Histogram
from dualbrain.control.gatekeeper.timing.tick_profile import Part
from dualbrain.safety.supervisor.conditions import Condition
from dualbrain.safety.supervisor.timing import Timing

BIN = 0.02
"""Histograms: bins of a fiftieth of a period up to twenty periods; the last bin holds what is beyond."""
WINDOW = 1.0
"""Late ticks are counted over so long [s]."""
WARM_UP = 0.2
"""So long [s] at the start nothing is held against anybody."""


class Punctuality(msgspec.Struct, frozen=True):
    """A summary [s]: percentiles (50, 99, 99.9, 100) of interval, work and latency; the shares of late ticks.

    `missed` states never came; `bins` are counts of intervals by `BIN` of a period; `parts`: what a tick is made of.
    """

    ticks: int
    missed: int
    late: int
    interval: tuple[float, float, float, float]
    work: tuple[float, float, float, float]
    latency: tuple[float, float, float, float]
    bins: tuple[int, ...]
    parts: dict[str, Part] = {}


class Metronome:
    """Told of each state's arrival, each command's leaving and each tick's end; all times monotonic [s]."""

    def __init__(self, timing: Timing) -> None:
        """Nothing has happened yet."""
        self._timing = timing
        self._interval, self._work, self._latency = (Histogram(BIN * timing.period) for _ in range(3))
        self._window, self._warm_up = (round(time / timing.period) for time in (WINDOW, WARM_UP))
        self._arrived: float | None = None
        self._sent = True
        self._recent: deque[bool] = deque(maxlen=self._window)
        self._late = self._overruns = 0
        self._ticks = self.missed = 0
        self._flags = 0

    def arrived(self, now: float, lost: int) -> None:
        """A state came, and `lost` before it never did."""
        if self._arrived is not None:
            gap = now - self._arrived
            self._interval.add(gap)
            if gap > self._timing.lost and self._ticks > self._warm_up:
                self._flags |= Condition.TICK_LOST
        self._arrived, self._sent = now, False
        self._ticks += 1
        self.missed += lost if self._ticks > self._warm_up else 0

    def sent(self, now: float) -> None:
        """The command that answers the last state leaves."""
        if self._arrived is None or self._sent:
            return
        self._sent = True
        latency = now - self._arrived
        self._latency.add(latency)
        if latency > self._timing.late:
            self._flags |= Condition.COMMAND_LATE

    def ended(self, now: float) -> None:
        """All work of the tick is done."""
        if self._arrived is None:
            return
        work = now - self._arrived
        self._work.add(work)
        late = work > self._timing.overrun and self._ticks > self._warm_up
        self._overruns += late - (self._recent[0] if len(self._recent) == self._window else False)
        self._recent.append(late)
        if late:
            self._late += 1
            self._flags |= Condition.TICK_OVERRUN
        if self._overruns > self._timing.overruns * self._window:
            self._flags |= Condition.TICKS_OVERRUN

    def flags(self) -> int:
        """`Condition` bits since the last call."""
        flags, self._flags = self._flags, 0
        return flags

    def summary(self) -> Punctuality:
        """Everything so far."""
        interval, work, latency = (one.summary() for one in (self._interval, self._work, self._latency))
        bins = tuple(self._interval.counts)
        return Punctuality(self._ticks, self.missed, self._late, interval, work, latency, bins)
