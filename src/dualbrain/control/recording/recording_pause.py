"""The pause of a recording while a robot without a commander is at rest, so that its file does not grow for days."""

from __future__ import annotations

UNATTENDED_TIME = 60.0
"""Time [s] without a commander, a contract and motion after which the recording pauses."""


class RecordingPause:
    """Decides when to pause; `update` is called once per tick."""

    def __init__(self, after: float = UNATTENDED_TIME) -> None:
        """Pause `after` seconds without activity, first counted from the first update."""
        self._after = after
        self._active_at: float | None = None

    def update(self, now: float, *, active: bool) -> bool:
        """Whether the recording is to pause at `now` [s]; `active`: it must not."""
        if active or self._active_at is None:
            self._active_at = now
        return now - self._active_at >= self._after
