"""Limit on attempts to enter the operator's code, for each page and for all pages together."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from math import inf

MAX_PAGE_FAILURES = 5
"""Wrong codes after which a page accepts no code any more; it must be loaded again."""
MAX_FAILURES = 20
"""Wrong codes on all pages together after which no page accepts a code until the end of the run."""
FREE_FAILURES = 2
"""Wrong codes on all pages together without a delay, for typing errors."""
FIRST_DELAY_S, MAX_DELAY_S = 1.0, 300.0
"""Delay [s] after the next wrong code, and the longest one; every further wrong code doubles the delay."""


class AttemptLimit:
    """Number of wrong codes, and the time from which the next code is read.

    A code that is entered during a delay is not read, so parallel pages gain nothing. A correct code ends the delays.
    """

    def __init__(self, clock: Callable[[], float]) -> None:
        """Start without wrong codes; `clock` returns the time [s]."""
        self._clock = clock
        self._failures, self._next_at = 0, -inf
        self._page_failures: Counter[int] = Counter()

    def wait_s(self, page: int) -> float:
        """Time [s] until `page` may enter a code: 0 at once, infinite never again."""
        if self._failures >= MAX_FAILURES or self._page_failures[page] >= MAX_PAGE_FAILURES:
            return inf
        return max(0.0, self._next_at - self._clock())

    def record_failure(self, page: int) -> None:
        """Count a wrong code on `page`."""
        self._failures += 1
        self._page_failures[page] += 1
        excess = self._failures - FREE_FAILURES
        if excess > 0:
            self._next_at = self._clock() + min(MAX_DELAY_S, FIRST_DELAY_S * 2.0 ** (excess - 1))

    def record_success(self, page: int) -> None:
        """Count a correct code on `page`."""
        self._failures, self._next_at = 0, -inf
        del self._page_failures[page]

    def remove_page(self, page: int) -> None:
        """Forget a page that was closed; its wrong codes remain in the number for all pages."""
        del self._page_failures[page]
