"""The progress watchdog: an arm that does not come closer has been taken over, whatever δ says (design 4)."""

from __future__ import annotations

STANDSTILL = 1.5
"""No progress for this long [s] ends the contract."""
STEP = 0.004
"""What counts as progress [m, or rad / 10]."""


class Progress:
    """Best distance so far and when it was reached."""

    def __init__(self, now: float, *, limit: float, patience: float = STANDSTILL) -> None:
        """Start the watch at `now` [s]; standing still may last `patience` [s], the whole motion `limit` [s]."""
        self._patience = patience
        self._best = float("inf")
        self._since = now
        self._end = now + limit

    def stuck(self, now: float, distance: float) -> str | None:
        """Why the motion is over, or None while it makes progress."""
        if distance < self._best - STEP:
            self._best, self._since = distance, now
        if now - self._since > self._patience:
            return f"no progress for {self._patience} s"
        if now > self._end:
            return "out of time"
        return None
