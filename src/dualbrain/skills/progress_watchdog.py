"""Progress watchdog: a skill without progress toward its goal is taken over, independent of δ (design 4)."""

from __future__ import annotations

PROGRESS_TIMEOUT = 1.5
"""Time without progress [s] after which the contract ends."""
MIN_PROGRESS = 0.004
"""Least decrease of the distance that counts as progress [m, or rad / 10]."""


class ProgressWatchdog:
    """Tracks the smallest distance and the time at which it was reached."""

    def __init__(self, now: float, *, time_limit: float, timeout: float = PROGRESS_TIMEOUT) -> None:
        """Start at `now` [s]; progress may stop for `timeout` [s], the whole motion may take `time_limit` [s]."""
        self._timeout = timeout
        self._best = float("inf")
        self._best_at = now
        self._deadline = now + time_limit

    def update(self, now: float, distance: float) -> str | None:
        """The reason to end the motion at `now` [s] and `distance` [m], or None while it makes progress."""
        if distance < self._best - MIN_PROGRESS:
            self._best, self._best_at = distance, now
        if now - self._best_at > self._timeout:
            return f"no progress for {self._timeout} s"
        if now > self._deadline:
            return "out of time"
        return None
