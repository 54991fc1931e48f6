"""The newest events of a robot, numbered, so that a client can ask for those after the last one it has."""

from __future__ import annotations

from collections import deque
from threading import Lock
from typing import Any

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
        self._events: deque[dict[str, Any]] = deque(maxlen=KEPT_EVENTS)

    def add(self, t: float, kind: str, text: str) -> None:
        """Append an event of `kind` at the robot's time `t` [s]."""
        with self._lock:
            self._number += 1
            event = {"number": self._number, "t": round(t, 3), "kind": kind, "text": storable_text(text, MAX_TEXT)}
            self._events.append(event)

    def after(self, number: int) -> list[dict[str, Any]]:
        """The kept events with a higher number than `number`; each has its number, time `t` [s], kind and text."""
        with self._lock:
            return [event for event in self._events if event["number"] > number]
