"""Timing of the control tick: interval, work and latency of every tick, as conditions and as histograms."""

from __future__ import annotations

from collections import deque

import msgspec

from dualbrain.control.gatekeeper.timing.histogram import Histogram
from dualbrain.control.gatekeeper.timing.tick_profile import PartTiming
from dualbrain.safety.control_thread import ControlThreadStatus
from dualbrain.safety.supervisor.conditions import Condition
from dualbrain.safety.supervisor.timing import Timing

BIN_FRACTION = 0.02
"""Width of the histograms' bins, as a fraction of the period: bins up to twenty periods."""
OVERRUN_WINDOW = 1.0
"""Time window over which late ticks are counted [s]."""
WARM_UP_TIME = 0.2
"""Time [s] at the start in which no tick counts as late."""


class TickTimingSummary(msgspec.Struct, frozen=True, kw_only=True):
    """Timing of `ticks`: percentiles (50, 99, 99.9, 100) of interval, work and latency [s].

    `late` ticks took too long, `missed` states never arrived. `bins` counts intervals by `BIN_FRACTION` of a period.
    `parts` is the tick profile, `control_thread` the state of the thread that moved the joints, None without one.
    """

    ticks: int
    missed: int
    late: int
    interval: tuple[float, float, float, float]
    work: tuple[float, float, float, float]
    latency: tuple[float, float, float, float]
    bins: tuple[int, ...]
    parts: dict[str, PartTiming] = {}
    control_thread: ControlThreadStatus | None = None


class TickTimer:
    """Measures ticks by the arrival of states, the sending of commands and the end of ticks, in monotonic time [s]."""

    def __init__(self, timing: Timing) -> None:
        """Start without ticks; `timing` has the limits."""
        self._timing = timing
        self._interval, self._work, self._latency = (Histogram(BIN_FRACTION * timing.period) for _ in range(3))
        self._window, self._warm_up = (round(time / timing.period) for time in (OVERRUN_WINDOW, WARM_UP_TIME))
        self._state_received_at: float | None = None
        self._command_sent = True
        self._recent_overruns: deque[bool] = deque(maxlen=self._window)
        self.late = self._overruns = 0
        self._ticks = self.missed = 0
        self._conditions = 0

    def on_state(self, now: float, lost: int) -> None:
        """Count a state that arrived, and `lost` states before it that did not."""
        if self._state_received_at is not None:
            gap = now - self._state_received_at
            self._interval.add(gap)
            if gap > self._timing.tick_lost_after and self._ticks > self._warm_up:
                self._conditions |= Condition.TICK_LOST
        self._state_received_at, self._command_sent = now, False
        self._ticks += 1
        self.missed += lost if self._ticks > self._warm_up else 0

    def on_command(self, now: float) -> None:
        """Count the command for the last state when it is sent."""
        if self._state_received_at is None or self._command_sent:
            return
        self._command_sent = True
        latency = now - self._state_received_at
        self._latency.add(latency)
        if latency > self._timing.command_deadline:
            self._conditions |= Condition.COMMAND_LATE

    def on_tick_end(self, now: float) -> None:
        """Count the end of the tick's work."""
        if self._state_received_at is None:
            return
        work = now - self._state_received_at
        self._work.add(work)
        late = work > self._timing.max_tick_time and self._ticks > self._warm_up
        self._overruns += late - (self._recent_overruns[0] if len(self._recent_overruns) == self._window else False)
        self._recent_overruns.append(late)
        if late:
            self.late += 1
            self._conditions |= Condition.TICK_OVERRUN
        if self._overruns > self._timing.max_overrun_fraction * self._window:
            self._conditions |= Condition.TICKS_OVERRUN

    def conditions(self) -> int:
        """`Condition` bits since the last call."""
        flags, self._conditions = self._conditions, 0
        return flags

    def summary(self) -> TickTimingSummary:
        """The timing of all ticks so far."""
        interval, work, latency = (one.summary() for one in (self._interval, self._work, self._latency))
        bins = tuple(self._interval.counts)
        return TickTimingSummary(
            ticks=self._ticks,
            missed=self.missed,
            late=self.late,
            interval=interval,
            work=work,
            latency=latency,
            bins=bins,
        )
