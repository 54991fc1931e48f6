"""Where the wall time of an episode goes: physics, monitor, filter, planner, rest."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar

import numpy as np

P = ParamSpec("P")
T = TypeVar("T")


class Stopwatch:
    """Sums the time spent in functions that it wraps, part by part; `clock` [s] is the caller's."""

    def __init__(self, clock: Callable[[], float]) -> None:
        """Nothing measured yet."""
        self._clock = clock
        self._begun = clock()
        self.spent: dict[str, float] = {}
        self.single: dict[str, list[float]] = {}

    def watch(self, owner: Any, method: str, part: str, *, each: bool = False) -> None:
        """Measure every call of `owner.method` from now on as `part`; `each` keeps the single times too."""
        setattr(owner, method, self.wrap(getattr(owner, method), part, each=each))

    def wrap(self, do: Callable[P, T], part: str, *, each: bool = False) -> Callable[P, T]:
        """`do`, measured as `part`."""
        clock, spent = self._clock, self.spent
        spent.setdefault(part, 0.0)
        single = self.single.setdefault(part, []) if each else None

        def timed(*args: P.args, **kwargs: P.kwargs) -> T:
            begun = clock()
            try:
                return do(*args, **kwargs)
            finally:
                took = clock() - begun
                spent[part] += took
                if single is not None:
                    single.append(took)

        return timed

    def split(self) -> dict[str, float]:
        """Seconds by part; `rest` is what no part has, `all` the whole."""
        whole = max(self._clock() - self._begun, 1e-9)
        return {**self.spent, "rest": max(0.0, whole - sum(self.spent.values())), "all": whole}

    def microseconds(self, part: str) -> list[float]:
        """Median, 99th percentile and maximum of the single times of `part` [µs]; empty if none were kept."""
        times = self.single.get(part)
        if not times:
            return []
        micro = 1e6 * np.array(times)
        return [float(np.quantile(micro, q)) for q in (0.5, 0.99, 1.0)]
