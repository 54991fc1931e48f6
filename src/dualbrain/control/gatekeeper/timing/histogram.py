"""Durations counted by bins: what a loop can afford to keep of every tick it has ever made."""

from __future__ import annotations

from itertools import accumulate

N_BINS = 1000


class Histogram:
    """Counts by bins of `width` [s]; the last of the `BINS` holds all that is beyond. `longest` is exact."""

    def __init__(self, width: float) -> None:
        """Nothing is counted yet."""
        self.width, self.counts = width, [0] * N_BINS
        self.n_samples, self.sum, self.maximum = 0, 0.0, 0.0

    def add(self, value: float) -> None:
        """Count `value` [s]."""
        self.counts[min(int(value / self.width), N_BINS - 1)] += 1
        self.n_samples += 1
        self.sum += value
        self.maximum = max(self.maximum, value)

    @property
    def mean(self) -> float:
        """Their mean [s]; 0 without any."""
        return self.sum / self.n_samples if self.n_samples else 0.0

    def quantile(self, fraction: float) -> float:
        """The upper end of the bin below which `share` of them lie [s], at most the longest; 0 without any."""
        if not self.n_samples:
            return 0.0
        k = next(k for k, below in enumerate(accumulate(self.counts)) if below >= fraction * self.n_samples)
        return self.maximum if k == N_BINS - 1 else min(self.maximum, self.width * (k + 1))

    def summary(self) -> tuple[float, float, float, float]:
        """The quantiles at 50, 99 and 99.9 %, and the longest [s]."""
        p50, p99, p999 = map(self.quantile, (0.5, 0.99, 0.999))
        return p50, p99, p999, self.maximum
