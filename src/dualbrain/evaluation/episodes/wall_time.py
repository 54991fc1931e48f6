"""Where the wall time of an episode goes: physics, monitor, filter, planner, rest.

The planner thinks on a thread of its own while the arm holds still and physics goes on. What overlaps is counted once.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar

import numpy as np

P = ParamSpec("P")
T = TypeVar("T")

PLANNER_TIME, UNCONSTRAINED_TIME, HOLD_TIME = "planner", "aside", "hold"
"""Times that overlap with others: a question, the one that only measures before it, and the arm's hold meanwhile."""


class Stopwatch:
    """Sums the time spent in functions that it wraps, part by part; `clock` [s] is the caller's."""

    def __init__(self, clock: Callable[[], float]) -> None:
        """Nothing measured yet."""
        self._clock = clock
        self._begun = clock()
        self.spent: dict[str, float] = {}
        self.durations: dict[str, list[float]] = {}

    def time_method(self, owner: Any, method: str, part: str, *, keep_each: bool = False) -> None:
        """Measure every call of `owner.method` from now on as `part`; `each` keeps the single times too."""
        setattr(owner, method, self.wrap(getattr(owner, method), part, keep_each=keep_each))

    def wrap(self, function: Callable[P, T], part: str, *, keep_each: bool = False) -> Callable[P, T]:
        """`do`, measured as `part`; of what overlaps with other parts the single times alone are kept."""
        clock, spent = self._clock, self.spent
        apart = part in (PLANNER_TIME, UNCONSTRAINED_TIME, HOLD_TIME)
        if not apart:
            spent.setdefault(part, 0.0)
        single = self.durations.setdefault(part, []) if keep_each or apart else None

        def timed(*args: P.args, **kwargs: P.kwargs) -> T:
            begun = clock()
            try:
                return function(*args, **kwargs)
            finally:
                took = clock() - begun
                if not apart:
                    spent[part] += took
                if single is not None:
                    single.append(took)

        return timed

    def split_seconds(self) -> dict[str, float]:
        """Seconds by part, which add up to `all`: the wall time that the episode takes when nothing is asked aside.

        `planner` is what it waited for the planner when the arm's hold was over, `rest` is what no part has.
        """
        waited, added = waiting_times(
            *(self.durations.get(part, []) for part in (PLANNER_TIME, HOLD_TIME, UNCONSTRAINED_TIME))
        )
        parts = {**self.spent, PLANNER_TIME: waited}
        whole = max(self._clock() - self._begun - added, 1e-9)
        return {**parts, "rest": max(0.0, whole - sum(parts.values())), "all": whole}

    def quantiles_us(self, part: str) -> list[float]:
        """Median, 99th percentile and maximum of the single times of `part` [µs]; empty if none were kept."""
        times = self.durations.get(part)
        if not times:
            return []
        micro = 1e6 * np.array(times)
        return [float(np.quantile(micro, q)) for q in (0.5, 0.99, 1.0)]


def waiting_times(
    planner_times: list[float], hold_times: list[float], unconstrained_times: list[float]
) -> tuple[float, float]:
    """What the planner, and what the question `aside`, added to the wall time [s].

    Both run one after the other beside the arm's hold, which takes time of its own: only what is longer is waited for.
    `asked` and `holds` come in pairs; what was asked aside came before the first question.
    """
    pairs = list(zip(planner_times, hold_times, strict=False))  # a question that a person interrupted has no end
    waited = sum(max(0.0, planner - hold) for planner, hold in pairs)
    if not pairs:
        return waited, 0.0
    planner, hold = pairs[0]
    return waited, max(0.0, sum(unconstrained_times) + planner - hold) - max(0.0, planner - hold)
