"""The progress watchdog: an arm that does not come closer has been taken over, whatever δ says (design 4)."""

from __future__ import annotations

PROGRESS_TIMEOUT = 1.5
"""No progress for this long [s] ends the contract."""
MIN_PROGRESS = 0.004
"""What counts as progress [m, or rad / 10]."""


class ProgressWatchdog:
    """Best distance so far and when it was reached."""

    def __init__(self, now: float, *, time_limit: float, timeout: float = PROGRESS_TIMEOUT) -> None:
        """Start the watch at `now` [s]; standing still may last `patience` [s], the whole motion `limit` [s]."""
        self._timeout = timeout
        self._best = float("inf")
        self._best_at = now
        self._deadline = now + time_limit

    def update(self, now: float, distance: float) -> str | None:
        """Why the motion is over, or None while it makes progress."""
        if distance < self._best - MIN_PROGRESS:
            self._best, self._best_at = distance, now
        if now - self._best_at > self._timeout:
            return f"no progress for {self._timeout} s"
        if now > self._deadline:
            return "out of time"
        return None
