"""What the parts of a control tick cost: a watch whose laps are named, read where one part ends and the next begins.

    wait → read → sense → skills → door → supervisor → filter → write → record → show → wait …

Some ticks have no skill (nobody commands) and few have anything to show. A part's time is the wall's: when another
thread (the gate, the recorder) has the interpreter meanwhile, its time is in it. What the control thread itself
computed is told beside it.
"""

from __future__ import annotations

from time import perf_counter, thread_time

import msgspec

from dualbrain.control.gatekeeper.timing.histogram import Histogram

TICK_PARTS = {
    "wait": "for the next joint state",
    "read": "packets of the robot's bus, decoded",
    "sense": "joint state and scene: plausible, fresh; obstacles to the filter",
    "skills": "the contract's nominal control φ",
    "door": "the socket: peers heard and answered, the gate's rulings taken in",
    "supervisor": "conditions to one order",
    "filter": "rows, quadratic program, checker, certificate; the control's own check",
    "write": "the command onto the robot's bus",
    "record": "trace and flight recorder",
    "show": "glimpses for who watches",
}
BIN_WIDTH = 2e-6
"""Bins of 2 µs, up to 2 ms."""


class PartTiming(msgspec.Struct, frozen=True):
    """What a part cost in the `ticks` that had it [s]; `quantiles` at 50, 99, 99.9, 100 %, `cpu` this thread's own."""

    ticks: int
    mean: float
    quantiles: tuple[float, float, float, float]
    cpu: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)


class TickProfiler:
    """Told of the end of each part with `lap`, of the end of each tick with `ended`."""

    def __init__(self) -> None:
        """The watch runs; what came before the first end of a tick is nobody's."""
        self._parts = {name: (Histogram(BIN_WIDTH), Histogram(BIN_WIDTH)) for name in TICK_PARTS}
        self._current_tick = {name: (0.0, 0.0) for name in TICK_PARTS}
        self._last_wall, self._last_cpu, self._started = perf_counter(), thread_time(), False

    def mark_part(self, part: str) -> None:
        """The time since the last lap was spent on `part`."""
        now, used = perf_counter(), thread_time()
        wall, own = self._current_tick[part]
        self._current_tick[part] = wall + now - self._last_wall, own + used - self._last_cpu
        self._last_wall, self._last_cpu = now, used

    def end_tick(self) -> None:
        """The tick is over: each part counts once, with all that was spent on it; this itself is no part's."""
        for part, (wall, own) in self._current_tick.items():
            if wall and self._started:
                whole, mine = self._parts[part]
                whole.add(wall)
                mine.add(own)
            self._current_tick[part] = 0.0, 0.0
        self._last_wall, self._last_cpu, self._started = perf_counter(), thread_time(), True

    def summary(self) -> dict[str, PartTiming]:
        """Every part so far."""
        return {
            name: PartTiming(whole.n_samples, whole.mean, whole.summary(), mine.summary())
            for name, (whole, mine) in self._parts.items()
        }
