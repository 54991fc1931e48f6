"""Durations counted by bins: what a loop can afford to keep of every tick it has ever made."""

from __future__ import annotations

from itertools import accumulate

BINS = 1000


class Histogram:
    """Counts by bins of `width` [s]; the last of the `BINS` holds all that is beyond. `longest` is exact."""

    def __init__(self, width: float) -> None:
        """Nothing is counted yet."""
        self.width, self.counts = width, [0] * BINS
        self.ticks, self.sum, self.longest = 0, 0.0, 0.0

    def add(self, value: float) -> None:
        """Count `value` [s]."""
        self.counts[min(int(value / self.width), BINS - 1)] += 1
        self.ticks += 1
        self.sum += value
        self.longest = max(self.longest, value)

    @property
    def mean(self) -> float:
        """Their mean [s]; 0 without any."""
        return self.sum / self.ticks if self.ticks else 0.0

    def quantile(self, share: float) -> float:
        """The upper end of the bin below which `share` of them lie [s], at most the longest; 0 without any."""
        if not self.ticks:
            return 0.0
        k = next(k for k, below in enumerate(accumulate(self.counts)) if below >= share * self.ticks)
        return self.longest if k == BINS - 1 else min(self.longest, self.width * (k + 1))

    def summary(self) -> tuple[float, float, float, float]:
        """The quantiles at 50, 99 and 99.9 %, and the longest [s]."""
        p50, p99, p999 = map(self.quantile, (0.5, 0.99, 0.999))
        return p50, p99, p999, self.longest
