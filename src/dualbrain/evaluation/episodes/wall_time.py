"""Wall time of an episode by part: physics, monitor, filter, planner, rest.

The planner runs on a separate thread while the simulated arm holds position. Overlapping time is counted once.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar

import numpy as np

P = ParamSpec("P")
T = TypeVar("T")

PLANNER_TIME, UNCONSTRAINED_TIME, HOLD_TIME = "planner", "unconstrained", "hold"
"""Parts that overlap with others: a request, the unconstrained request before it, and the arm's hold meanwhile."""


class Stopwatch:
    """Sums the time spent in functions that it wraps, part by part; `clock` [s] is the caller's."""

    def __init__(self, clock: Callable[[], float]) -> None:
        """Start the measurement."""
        self._clock = clock
        self._started = clock()
        self.spent: dict[str, float] = {}
        self.durations: dict[str, list[float]] = {}

    def time_method(self, owner: Any, method: str, part: str, *, keep_each: bool = False) -> None:
        """Measure every further call of `owner.method` as `part`; `keep_each` also keeps the single times."""
        setattr(owner, method, self.wrap(getattr(owner, method), part, keep_each=keep_each))

    def wrap(self, function: Callable[P, T], part: str, *, keep_each: bool = False) -> Callable[P, T]:
        """`function`, measured as `part`; of parts that overlap with others, only the single times are kept."""
        clock, spent = self._clock, self.spent
        overlaps = part in (PLANNER_TIME, UNCONSTRAINED_TIME, HOLD_TIME)
        if not overlaps:
            spent.setdefault(part, 0.0)
        single_times = self.durations.setdefault(part, []) if keep_each or overlaps else None

        def timed(*args: P.args, **kwargs: P.kwargs) -> T:
            start = clock()
            try:
                return function(*args, **kwargs)
            finally:
                duration = clock() - start
                if not overlaps:
                    spent[part] += duration
                if single_times is not None:
                    single_times.append(duration)

        return timed

    def split_seconds(self) -> dict[str, float]:
        """Wall time [s] by part, which adds up to `all`, the time of the episode without the unconstrained request.

        `planner` is the time that the loop waited for the planner after the arm's hold; `rest` belongs to no part.
        """
        waited, added = waiting_times(
            *(self.durations.get(part, []) for part in (PLANNER_TIME, HOLD_TIME, UNCONSTRAINED_TIME))
        )
        parts = {**self.spent, PLANNER_TIME: waited}
        total = max(self._clock() - self._started - added, 1e-9)
        return {**parts, "rest": max(0.0, total - sum(parts.values())), "all": total}

    def quantiles_us(self, part: str) -> list[float]:
        """Median, 99th percentile and maximum of the single times of `part` [µs]; empty if none were kept."""
        times = self.durations.get(part)
        if not times:
            return []
        microseconds = 1e6 * np.array(times)
        return [float(np.quantile(microseconds, q)) for q in (0.5, 0.99, 1.0)]


def waiting_times(
    planner_times: list[float], hold_times: list[float], unconstrained_times: list[float]
) -> tuple[float, float]:
    """Wall time [s] that the planner, and that the unconstrained request, add to an episode.

    Both run one after the other, in parallel with the arm's hold: only the time beyond the hold is added. The planner
    and hold times come in pairs; the unconstrained request precedes the first planner request.
    """
    pairs = list(zip(planner_times, hold_times, strict=False))  # a request that a person interrupted has no end
    waited = sum(max(0.0, planner - hold) for planner, hold in pairs)
    if not pairs:
        return waited, 0.0
    planner, hold = pairs[0]
    return waited, max(0.0, sum(unconstrained_times) + planner - hold) - max(0.0, planner - hold)
