"""Pacing of a simulation to the wall clock."""

from __future__ import annotations

import time


class RealTimePacer:
    """Prevents simulated time from running ahead of the wall clock; a simulation that is late does not catch up."""

    def __init__(self, *, tolerance: float, min_sleep: float = 0.0) -> None:
        """Start with the first call.

        A deviation of more than `tolerance` [s] starts the measurement again, and a lead of up to `min_sleep` [s] is
        not slept off: short sleeps take longer than requested.
        """
        self._tolerance, self._min_sleep = tolerance, min_sleep
        self._clock_offset = 0.0

    def __call__(self, now: float) -> None:
        """Sleep until the wall clock reaches the simulated time `now` [s]."""
        early = self._clock_offset + now - time.monotonic()
        if abs(early) > self._tolerance:
            self._clock_offset, early = time.monotonic() - now, 0.0
        if early > self._min_sleep:
            time.sleep(early)
