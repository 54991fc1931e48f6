"""Tick profile: time that each part of a control tick takes.

    wait → read → sense → skills → door → supervisor → filter → write → record → show → wait …

Ticks without a contract have no `skills`, and few ticks have a `show`. The time of a part is wall time: it contains the
time of another thread (the recorder) that runs meanwhile. The CPU time of the control thread is given as well.
"""

from __future__ import annotations

from array import array
from time import perf_counter, thread_time

import msgspec
import numpy as np

from dualbrain.control.gatekeeper.timing.histogram import Histogram

TICK_PARTS = {
    "wait": "waiting for the next joint state",
    "read": "decoding of packets from the robot",
    "sense": "plausibility and age of joint state and scene; obstacles of the filter",
    "skills": "nominal control φ of the contract",
    "door": "socket server: messages, replies, verdicts of the gate",
    "supervisor": "supervisor: conditions to a decision",
    "filter": "rows, quadratic program, checks and certificate of the control",
    "write": "sending of the command to the robot",
    "record": "trace and recorder",
    "show": "tick reports for observers",
}
"""Description of each part of a tick, by the name under which its time is stored."""
BIN_WIDTH = 2e-6
"""Width of the histograms' bins [s]: 1000 bins up to 2 ms."""

BATCH_TICKS = 500
"""Number of ticks whose samples are counted together."""


class PartTiming(msgspec.Struct, frozen=True):
    """Time of a part over the `ticks` that had it [s].

    `mean` and `quantiles` (50, 99, 99.9, 100 %) are wall time; `cpu` has quantiles of the control thread's CPU time.
    """

    ticks: int
    mean: float
    quantiles: tuple[float, float, float, float]
    cpu: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)


class TickProfiler:
    """Measures the parts of ticks: call `mark_part` at the end of each part and `end_tick` at the end of each tick."""

    def __init__(self) -> None:
        """Start the measurement; the time before the first end of a tick is not counted."""
        self._parts = {name: (Histogram(BIN_WIDTH), Histogram(BIN_WIDTH)) for name in TICK_PARTS}
        self._index = {name: 2 * i for i, name in enumerate(TICK_PARTS)}
        self._no_time = [0.0] * (2 * len(TICK_PARTS))
        self._current_tick = self._no_time.copy()
        self._ticks = array("d")
        self._last_wall, self._last_cpu, self._started = perf_counter(), thread_time(), False

    def mark_part(self, part: str) -> None:
        """Add the time since the last mark to `part`."""
        now, used = perf_counter(), thread_time()
        index, times = self._index[part], self._current_tick
        times[index] += now - self._last_wall
        times[index + 1] += used - self._last_cpu
        self._last_wall, self._last_cpu = now, used

    def end_tick(self) -> None:
        """End a tick: the total time of each part is one sample. The time of this method belongs to no part.

        The samples are counted `BATCH_TICKS` ticks at a time, which takes a tenth of the time.
        """
        if self._started:
            self._ticks.extend(self._current_tick)
            if len(self._ticks) >= BATCH_TICKS * len(self._no_time):
                self._count_samples()
        self._current_tick = self._no_time.copy()
        self._last_wall, self._last_cpu, self._started = perf_counter(), thread_time(), True

    def _count_samples(self) -> None:
        times = np.array(self._ticks).reshape(-1, len(TICK_PARTS), 2)
        self._ticks = array("d")
        for index, (wall_times, cpu_times) in enumerate(self._parts.values()):
            present = times[:, index, 0] > 0.0
            wall_times.add_all(times[present, index, 0])
            cpu_times.add_all(times[present, index, 1])

    def summary(self) -> dict[str, PartTiming]:
        """The timing of every part so far, by its name."""
        self._count_samples()
        return {
            name: PartTiming(wall_times.n_samples, wall_times.mean, wall_times.summary(), cpu_times.summary())
            for name, (wall_times, cpu_times) in self._parts.items()
        }
