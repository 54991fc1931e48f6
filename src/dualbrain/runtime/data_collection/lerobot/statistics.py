"""Statistics of the features, by the definitions of LeRobot 0.6.1, in the same precision: its readers expect these.

Mean and mean square are computed in single precision for single-precision features and truth values, in double
precision for integers; std = √max(0, E[x²] − E[x]²). A quantile is that of a histogram of 5,000 bins over the range,
interpolated linearly within its bin. Over several episodes, a quantile is the mean of theirs, weighted by frames.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

QUANTILES = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}
STATISTICS = ("min", "max", "mean", "std", "count", *QUANTILES)
BINS = 5000
PADDING = 1e-10
"""Widening of the range of a histogram at either end."""

FeatureStatistics = dict[str, NDArray[Any]]


def feature_statistics(values: NDArray[Any]) -> FeatureStatistics:
    """The statistics of `values` (K,) or (K, m) over the K ≥ 1 frames: `count` (1,), the others (1,) or (m,)."""
    column = values.reshape(len(values), -1)
    if len(column) < 2:
        mean = np.mean(column, axis=0)
        basic = {"min": np.min(column, axis=0), "max": np.max(column, axis=0), "mean": mean}
        basic |= {"std": np.std(column, axis=0), "count": np.array([len(column)])}
        return basic | {name: mean.copy() for name in QUANTILES}
    column = column.astype(np.result_type(column.dtype, np.float32), copy=False)
    mean = np.mean(column, axis=0)
    variance = np.mean(column**2, axis=0) - mean**2
    found = {"min": np.min(column, axis=0), "max": np.max(column, axis=0), "mean": mean}
    found |= {"std": np.sqrt(np.maximum(0, variance)), "count": np.array([len(column)])}
    quantiles = np.array([_histogram_quantiles(column[:, entry]) for entry in range(column.shape[1])])
    return found | {name: quantiles[:, place] for place, name in enumerate(QUANTILES)}


def aggregate_statistics(episodes: Sequence[Mapping[str, FeatureStatistics]]) -> dict[str, FeatureStatistics]:
    """The statistics over all `episodes`, by feature."""
    return {name: _aggregate([episode[name] for episode in episodes]) for name in episodes[0]}


def plain_statistics(statistics: Mapping[str, FeatureStatistics]) -> dict[str, dict[str, list[Any]]]:
    """The `statistics` as lists of numbers, for JSON and for the table of episodes."""
    return {feature: {name: value.tolist() for name, value in values.items()} for feature, values in statistics.items()}


def _aggregate(parts: Sequence[FeatureStatistics]) -> FeatureStatistics:
    counts = np.stack([part["count"] for part in parts])
    total = counts.sum(axis=0)
    means = np.stack([part["mean"] for part in parts])
    mean = (means * counts).sum(axis=0) / total
    variances = np.stack([part["std"] ** 2 for part in parts]) + (means - mean) ** 2
    found = {
        "min": np.min(np.stack([part["min"] for part in parts]), axis=0),
        "max": np.max(np.stack([part["max"] for part in parts]), axis=0),
        "mean": mean,
        "std": np.sqrt((variances * counts).sum(axis=0) / total),
        "count": total,
    }
    quantiles = {name: np.stack([part[name] for part in parts]) for name in QUANTILES}
    return found | {name: (values * counts).sum(axis=0) / total for name, values in quantiles.items()}


def _histogram_quantiles(values: NDArray[Any]) -> list[float]:
    edges = cast("NDArray[Any]", np.linspace(values.min() - PADDING, values.max() + PADDING, BINS + 1))
    below = np.cumsum(np.histogram(values, bins=edges)[0])
    return [_quantile(edges, below, share * len(values)) for share in QUANTILES.values()]


def _quantile(edges: NDArray[Any], below: NDArray[Any], target: float) -> float:
    """The value below which `target` of the values lie; `below` (BINS,) are the cumulated counts of the bins."""
    place = int(np.searchsorted(below, target))
    if place == 0 or place >= len(below):
        return float(edges[0] if place == 0 else edges[-1])
    inside = below[place] - below[place - 1]
    return float(edges[place] + (target - below[place - 1]) / inside * (edges[place + 1] - edges[place]))
