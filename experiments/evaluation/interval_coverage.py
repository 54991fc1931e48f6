"""Coverage of 95 % intervals of a rate in clustered episodes, by simulation.

    python -m experiments.evaluation.interval_coverage [--samples 2000] [--write-docs]

Each sample has 40 clusters of 10 episodes. The rate of a cluster is drawn from a beta distribution with mean p and
intra-cluster correlation ICC, so that the hits of a cluster are beta-binomial. The table shows, for each method, how
many of the intervals contain p, and their mean width. All draws are seeded. The table goes to stdout, and with
`--write-docs` below the marker line of docs/explanation/statistics.md. The run takes some minutes.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy import stats
from statsmodels.stats.proportion import proportion_confint

from dualbrain.evaluation.analysis.statistics import (
    CONFIDENCE_LEVEL,
    MIN_CLUSTERS_FOR_BOOTSTRAP,
    N_RESAMPLES,
    design_effect,
    korn_graubard_interval,
    percentile_interval,
)
from experiments.figures.tables import markdown_table

Array = NDArray[np.float64]
PAGE = Path(__file__).resolve().parents[2] / "docs" / "explanation" / "statistics.md"
MARKER = "<!-- python -m experiments.evaluation.interval_coverage --write-docs writes all that follows -->"
N_CLUSTERS, CLUSTER_SIZE = 40, 10
N_EPISODES = N_CLUSTERS * CLUSTER_SIZE
CORRELATIONS = (0.0, 0.2, 0.5, 0.9)
RATES = (0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5)
ALPHA = 1.0 - CONFIDENCE_LEVEL


def main() -> int:
    """Run the simulation and print its tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--samples", type=int, default=2000)
    parser.add_argument("--write-docs", action="store_true")
    arguments = parser.parse_args()
    text = "\n".join(report_lines(arguments.samples))
    print(text)
    if arguments.write_docs:
        above = PAGE.read_text(encoding="utf-8").partition(MARKER)[0]
        PAGE.write_text(f"{above}{MARKER}\n\n{text}\n", encoding="utf-8")
    return 0


def report_lines(n_samples: int) -> list[str]:
    """One table for each correlation, and the lowest coverage of each method."""
    lowest = dict.fromkeys(METHODS, 1.0)
    lines: list[str] = []
    for correlation in CORRELATIONS:
        rows: list[list[str]] = []
        for rate in RATES:
            sys.stderr.write(f"ICC {correlation:g}, p {rate:g}\n")
            hits = draw_hits(rate, correlation, n_samples)
            found = {name: coverage(method(hits), rate) for name, method in METHODS.items()}
            lowest = {name: min(lowest[name], found[name][0]) for name in METHODS}
            cells = [f"{100 * share:.1f} ({100 * width:.1f})" for share, width in found.values()]
            rows.append([f"{rate:g}", *cells, f"{100 * has_few_clusters(hits).mean():.0f} %"])
        header = ["p", *METHODS, "few clusters"]
        lines += [f"### ICC {correlation:g}", "", *markdown_table(header, rows)]
    cells = [f"{100 * share:.1f}" for share in lowest.values()]
    lines += ["### Lowest coverage", "", *markdown_table(["", *METHODS], [["lowest of all cells", *cells]])]
    error = 100.0 * np.sqrt(0.95 * 0.05 / n_samples)
    return [*lines, f"{n_samples} samples per cell; the standard error of a coverage of 95 % is {error:.1f} points."]


def draw_hits(rate: float, correlation: float, n_samples: int) -> Array:
    """Hits by sample and cluster (n_samples, N_CLUSTERS)."""
    rng = np.random.default_rng([round(1e4 * rate), round(1e4 * correlation)])
    rates = np.full((n_samples, N_CLUSTERS), rate)
    if correlation:
        scale = 1.0 / correlation - 1.0
        rates = rng.beta(rate * scale, (1.0 - rate) * scale, size=rates.shape)
    return rng.binomial(CLUSTER_SIZE, rates).astype(float)


def coverage(intervals: Array, rate: float) -> tuple[float, float]:
    """Share of the `intervals` (n_samples, 2) that contain `rate`, and their mean width; NaN ends contain nothing."""
    low, high = intervals.T
    widths = (high - low)[~np.isnan(low)]
    return float(np.mean((low <= rate) & (rate <= high))), float(widths.mean()) if len(widths) else np.nan


def jeffreys_at_n(hits: Array) -> Array:
    """Jeffreys' interval that ignores the clusters."""
    return _jeffreys(hits.sum(axis=1), np.full(len(hits), float(N_EPISODES)))


def shrunken_correlation(hits: Array) -> Array:
    """Interval of the reports until 2026-11-24: Jeffreys at n/D, D from a shrunken estimate of the correlation.

    ρ = (1 + kρ̂)/(1 + k), where k is the number of clusters with a hit (or with a miss, if fewer).
    """
    n_informative = np.minimum((hits > 0).sum(axis=1), (hits < CLUSTER_SIZE).sum(axis=1))
    estimated = np.minimum((_design_effects(hits) - 1.0) / (CLUSTER_SIZE - 1.0), 1.0)
    correlation = (1.0 + n_informative * estimated) / (1.0 + n_informative)
    n = N_EPISODES / (1.0 + (CLUSTER_SIZE - 1.0) * correlation)
    return _jeffreys(hits.mean(axis=1) / CLUSTER_SIZE * n, n)


def korn_graubard(at_zero_variance: int) -> Callable[[Array], Array]:
    """Korn-Graubard interval with n* = `at_zero_variance` for samples without hits, or without misses."""

    def intervals(hits: Array) -> Array:
        level = 0.5 * (1.0 + CONFIDENCE_LEVEL)
        t_ratio = stats.t(N_EPISODES - 1).ppf(level) / stats.t(N_CLUSTERS - 1).ppf(level)
        p = hits.mean(axis=1) / CLUSTER_SIZE
        n = np.where((p > 0.0) & (p < 1.0), N_EPISODES / _design_effects(hits) * t_ratio**2, float(at_zero_variance))
        return np.transpose(proportion_confint(p * n, n, alpha=ALPHA, method="beta"))

    return intervals


def korn_graubard_of_reports(hits: Array) -> Array:
    """Korn-Graubard interval as the reports compute it (`korn_graubard_interval`)."""
    return _by_sample(korn_graubard_interval, hits)


def gee(hits: Array) -> Array:
    """Logit interval of an intercept-only GEE with exchangeable correlation and robust standard error (Liang, Zeger).

    For clusters of equal size the estimate is the mean, and the robust variance is Σ(k_i − p n_i)²/(n p(1 − p))². The
    interval does not exist without hits or without misses.
    """
    p = hits.mean(axis=1) / CLUSTER_SIZE
    with np.errstate(divide="ignore", invalid="ignore"):
        residual = ((hits - p[:, None] * CLUSTER_SIZE) ** 2).sum(axis=1)
        error = np.sqrt(residual) / (N_EPISODES * p * (1.0 - p))
        centre, half = np.log(p / (1.0 - p)), stats.norm.ppf(0.5 * (1.0 + CONFIDENCE_LEVEL)) * error
        return 1.0 / (1.0 + np.exp(-np.transpose([centre - half, centre + half])))


def cluster_bootstrap(hits: Array) -> Array:
    """Expanded percentile interval from resampled clusters; of no width if all clusters are equal."""
    rng = np.random.default_rng(0)
    counts = rng.multinomial(N_CLUSTERS, np.full(N_CLUSTERS, 1.0 / N_CLUSTERS), size=N_RESAMPLES).astype(float)
    draws = hits @ counts.T / N_EPISODES
    return np.array([percentile_interval(one, N_CLUSTERS) for one in draws])


def reported(hits: Array) -> Array:
    """Interval of the reports: bootstrap, or Korn-Graubard if few clusters have a hit (or a miss)."""
    return np.where(has_few_clusters(hits)[:, None], korn_graubard_of_reports(hits), cluster_bootstrap(hits))


def has_few_clusters(hits: Array) -> NDArray[np.bool_]:
    """Whether fewer than five clusters of a sample have a hit, or a miss."""
    n_informative = np.minimum((hits > 0).sum(axis=1), (hits < CLUSTER_SIZE).sum(axis=1))
    return n_informative < MIN_CLUSTERS_FOR_BOOTSTRAP


def _jeffreys(hits: Array, n: Array) -> Array:
    low, high = proportion_confint(hits, n, alpha=ALPHA, method="jeffreys")
    return np.transpose([np.where(hits == 0.0, 0.0, low), np.where(hits == n, 1.0, high)])


def _design_effects(hits: Array) -> Array:
    return np.array([design_effect(_clusters(one)) for one in hits])


def _by_sample(interval: Callable[[list[Array]], tuple[float, float]], hits: Array) -> Array:
    """`interval` of each sample, computed once for samples that differ only in the order of their clusters."""
    known: dict[tuple[float, ...], tuple[float, float]] = {}
    for one in hits:
        key = tuple(sorted(one))
        if key not in known:
            known[key] = interval(_clusters(one))
    return np.array([known[tuple(sorted(one))] for one in hits])


def _clusters(hits: Array) -> list[Array]:
    return list((np.arange(CLUSTER_SIZE) < hits[:, None]).astype(float))


METHODS: Mapping[str, Callable[[Array], Array]] = {
    "Jeffreys at n": jeffreys_at_n,
    "shrunken ICC": shrunken_correlation,
    "KG, n* = n at 0": korn_graubard(N_EPISODES),
    "KG, n* = m at 0": korn_graubard(N_CLUSTERS),
    "KG of the reports": korn_graubard_of_reports,
    "GEE": gee,
    "cluster bootstrap": cluster_bootstrap,
    "reports": reported,
}
"""Interval by method, from hits (n_samples, N_CLUSTERS) to ends (n_samples, 2)."""


if __name__ == "__main__":
    raise SystemExit(main())
