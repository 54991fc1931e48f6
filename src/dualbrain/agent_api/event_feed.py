"""The newest events of a robot, numbered, so that a client can ask for those after the last one it has."""

from __future__ import annotations

from collections import deque
from threading import Lock
from typing import Any, cast

from dualbrain.control.recording.trace import Event, EventKind
from dualbrain.core.text import storable_text

KEPT_EVENTS = 500
"""Number of events that are kept."""
MAX_TEXT = 400
"""Longest text of an event [characters]."""


class EventFeed:
    """Events in the order of their arrival; every method may be called from any thread."""

    def __init__(self) -> None:
        """Start without events."""
        self._lock, self._number = Lock(), 0
        self._events: deque[tuple[int, Event]] = deque(maxlen=KEPT_EVENTS)

    @property
    def newest(self) -> int:
        """Number of the newest event, 0 without one."""
        with self._lock:
            return self._number

    def add(self, t: float, kind: str, text: str, data: dict[str, Any] | None = None) -> None:
        """Append an event of `kind` at the robot's time `t` [s]; clients do not get its `data`."""
        event = Event(round(t, 3), cast("EventKind", kind), storable_text(text, MAX_TEXT), data or {})
        with self._lock:
            self._number += 1
            self._events.append((self._number, event))

    def after(self, number: int) -> list[dict[str, Any]]:
        """The kept events with a higher number than `number`; each has its number, time `t` [s], kind and text."""
        return [{"number": n, "t": one.t, "kind": one.kind, "text": one.text} for n, one in self._later(number)]

    def events_after(self, number: int) -> list[Event]:
        """The kept events with a higher number than `number`, with their data."""
        return [event for _, event in self._later(number)]

    def _later(self, number: int) -> list[tuple[int, Event]]:
        with self._lock:
            return [one for one in self._events if one[0] > number]
