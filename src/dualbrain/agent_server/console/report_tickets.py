"""Tickets for reports: a frame cannot send the token, so it loads an address that is valid once and for a short time.

The token itself is never in an address, where a log or the history of the browser would keep it.
"""

from __future__ import annotations

import secrets
from collections.abc import Callable
from threading import Lock

LIFETIME = 30.0
"""Time for which a ticket is valid [s]."""
MAX_TICKETS = 100
"""Number of valid tickets; a further one replaces the oldest."""


class ReportTickets:
    """Valid tickets and the runs that they name; every method may be called from any thread."""

    def __init__(self, clock: Callable[[], float]) -> None:
        """Start without tickets; `clock` returns the time [s]."""
        self._clock, self._lock = clock, Lock()
        self._runs = dict[str, tuple[str, float]]()

    def issue(self, run: str) -> str:
        """A new ticket for the report of `run`."""
        ticket = secrets.token_urlsafe(24)
        with self._lock:
            while len(self._runs) >= MAX_TICKETS:
                del self._runs[next(iter(self._runs))]
            self._runs[ticket] = run, self._clock() + LIFETIME
        return ticket

    def redeem(self, ticket: str) -> str:
        """The run of a valid ticket, which is invalid from then on; "" for any other."""
        with self._lock:
            run, expires = self._runs.pop(ticket, ("", 0.0))
        return run if self._clock() < expires else ""
