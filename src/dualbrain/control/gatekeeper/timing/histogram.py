"""Histogram of durations, with constant memory and constant time per sample."""

from __future__ import annotations

from itertools import accumulate

import numpy as np
from numpy.typing import NDArray

N_BINS = 1000
"""Number of bins; the last one also counts all longer durations."""


class Histogram:
    """Counts in bins of `width` [s]; `n_samples`, `sum` [s] and `maximum` [s] are exact."""

    def __init__(self, width: float) -> None:
        """Start without samples."""
        self.width, self.counts = width, [0] * N_BINS
        self.n_samples, self.sum, self.maximum = 0, 0.0, 0.0

    def add(self, value: float) -> None:
        """Count `value` [s]."""
        self.counts[min(int(value / self.width), N_BINS - 1)] += 1
        self.n_samples += 1
        self.sum += value
        self.maximum = max(self.maximum, value)

    def add_all(self, values: NDArray[np.float64]) -> None:
        """Count all `values` [s]."""
        if not len(values):
            return
        counts = np.bincount(np.minimum((values / self.width).astype(np.intp), N_BINS - 1), minlength=N_BINS)
        self.counts = (np.asarray(self.counts) + counts).tolist()
        self.n_samples += len(values)
        self.sum += float(values.sum())
        self.maximum = max(self.maximum, float(values.max()))

    @property
    def mean(self) -> float:
        """Mean of the samples [s]; 0 without samples."""
        return self.sum / self.n_samples if self.n_samples else 0.0

    def quantile(self, fraction: float) -> float:
        """Upper end [s] of the bin that contains the quantile `fraction`, at most the maximum; 0 without samples."""
        if not self.n_samples:
            return 0.0
        k = next(k for k, below in enumerate(accumulate(self.counts)) if below >= fraction * self.n_samples)
        return self.maximum if k == N_BINS - 1 else min(self.maximum, self.width * (k + 1))

    def summary(self) -> tuple[float, float, float, float]:
        """The quantiles at 50, 99 and 99.9 %, and the maximum [s]."""
        p50, p99, p999 = map(self.quantile, (0.5, 0.99, 0.999))
        return p50, p99, p999, self.maximum
