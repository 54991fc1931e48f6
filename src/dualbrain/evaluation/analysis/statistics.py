"""Intervals and tests for paired, clustered episodes (paper 7.5).

Episodes of one run share a ledger, and episodes in one scene share its difficulty. The bootstrap therefore resamples
clusters (runs), not episodes, and methods are compared on the same clusters, so that the difficulty of a scene cancels.
`docs/explanation/statistics.md` lists the methods, their references and the measured coverage of the intervals.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

Array = NDArray[np.float64]
Clusters = Mapping[str, Sequence[float]]
"""Values by cluster."""

N_RESAMPLES = 20_000
CONFIDENCE_LEVEL = 0.95
N_SIGN_DRAWS = 99_999
"""Number of sign patterns of the sign-flip test. Up to 16 clusters have fewer patterns: all are then counted."""
SIGN_BATCH = 20_000
"""Sign patterns held in memory at a time."""
MIN_CLUSTERS_FOR_BOOTSTRAP = 5
"""A rate is resampled only if at least this many clusters contain a hit, and this many a miss."""
MIN_CLUSTERS_FOR_VARIANCE = 2
"""The variance of a rate is estimated only if at least this many clusters contain a hit, and this many a miss."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Estimate:
    """Mean, standard deviation and 95 % interval of `n` values in `clusters` clusters; NaN if there are no values."""

    mean: float
    sd: float
    low: float
    high: float
    n: int
    clusters: int


def estimate(values: Clusters, *, is_rate: bool = False, seed: int = 0) -> Estimate:
    """Mean over all values, with an interval from a bootstrap over clusters.

    A rate (values 0 and 1) that has hits, or misses, in fewer than `MIN_CLUSTERS_FOR_BOOTSTRAP` clusters gets the
    interval of `korn_graubard_interval`. Any other quantity that comes from a single cluster, or that has the same
    value everywhere, has no spread to resample, and its interval is unbounded (−∞ to ∞).
    """
    filled = [np.array(one, float) for one in values.values() if len(one)]
    if not filled:
        return Estimate(mean=np.nan, sd=np.nan, low=np.nan, high=np.nan, n=0, clusters=0)
    flat = np.concatenate(filled)
    sd = float(flat.std(ddof=1)) if len(flat) > 1 else 0.0
    low, high = _rate_interval(filled, seed) if is_rate else _bootstrap_interval(filled, seed)
    return Estimate(mean=float(flat.mean()), sd=sd, low=low, high=high, n=len(flat), clusters=len(filled))


def _bootstrap_interval(clusters: Sequence[Array], seed: int) -> tuple[float, float]:
    if len(clusters) < 2 or not np.ptp(np.concatenate(clusters)):
        return -np.inf, np.inf
    return percentile_interval(_bootstrap_means(clusters, seed), len(clusters))


def _rate_interval(clusters: Sequence[Array], seed: int) -> tuple[float, float]:
    if min(_hit_and_miss_clusters(clusters)) >= MIN_CLUSTERS_FOR_BOOTSTRAP:
        return _bootstrap_interval(clusters, seed)
    return korn_graubard_interval(clusters)


def korn_graubard_interval(clusters: Sequence[Array]) -> tuple[float, float]:
    """95 % interval of a rate in clusters: Clopper-Pearson at the effective sample size (Korn and Graubard 1998).

    With the rate p and n* = `effective_sample_size(clusters)`, the interval is that of p·n* hits in n* independent
    trials.
    """
    n = effective_sample_size(clusters)
    return _binomial_interval(float(np.concatenate(clusters).mean()) * n, n, "beta")


def _binomial_interval(hits: float, n: float, method: str) -> tuple[float, float]:
    """95 % interval of a share of independent trials; `hits` and `n` need not be integers."""
    from statsmodels.stats.proportion import proportion_confint  # noqa: PLC0415  (heavy imports are lazy)

    low, high = np.array(proportion_confint(hits, n, alpha=1.0 - CONFIDENCE_LEVEL, method=method), float)
    return float(low), float(high)


def effective_sample_size(clusters: Sequence[Array]) -> float:
    """Effective sample size n* of a rate p, measured by n episodes in m clusters (Korn and Graubard 1998).

    n* = n_eff (t_{n−1}/t_{m−1})², where t_k is the 0.975 quantile of Student's t with k degrees of freedom, and
    n_eff = p(1 − p)/var(p) = n/D with the design effect D ≥ 1 of `design_effect`, so that n_eff ≤ n.

    Convention where var(p) cannot be estimated: if fewer than two clusters contain a hit (or a miss), n* = m, which is
    n divided by the largest possible design effect, that of fully correlated episodes. Reasons: without hits the
    estimated variance is 0, and with hits in one cluster it rests on that cluster alone. For every correlation within
    clusters the probability of no hit in a cluster is at most 1 − p, and that of no hit at all at most (1 − p)^m, so
    the upper end for 0 hits, 1 − 0.025^(1/m), keeps its level. Survey software often sets n* = n instead, which assumes
    that the episodes of a cluster are independent.
    """
    n, m = sum(map(len, clusters)), len(clusters)
    if min(_hit_and_miss_clusters(clusters)) < MIN_CLUSTERS_FOR_VARIANCE:
        return float(m)
    level = 0.5 * (1.0 + CONFIDENCE_LEVEL)
    t_ratio = float(stats.t(n - 1).ppf(level) / stats.t(m - 1).ppf(level))
    return n / design_effect(clusters) * t_ratio**2


def _hit_and_miss_clusters(clusters: Sequence[Array]) -> tuple[int, int]:
    """Number of clusters that contain a hit, and number that contain a miss."""
    return sum(bool(one.max()) for one in clusters), sum(not one.min() for one in clusters)


def _bootstrap_means(clusters: Sequence[Array], seed: int) -> Array:
    """Means of resampled clusters, shape (N_RESAMPLES,)."""
    sums, counts = (np.array([f(one) for one in clusters], float) for f in (np.sum, len))
    chosen = np.random.default_rng([seed, len(clusters)]).integers(len(clusters), size=(N_RESAMPLES, len(clusters)))
    return sums[chosen].sum(axis=1) / counts[chosen].sum(axis=1)


def percentile_interval(draws: Array, n: int) -> tuple[float, float]:
    """95 % interval from bootstrap draws of `n` units: percentiles, expanded for small n (Hesterberg 2015, 4.3).

    The tails are Φ(−sqrt(n/(n−1)) t_{1−α/2, n−1}) instead of α/2. Plain percentiles of ten units cover about 89 %.
    """
    wide = np.sqrt(n / (n - 1)) * stats.t(n - 1).ppf(0.5 * (1.0 + CONFIDENCE_LEVEL))
    tail = float(stats.norm.cdf(-wide))
    with np.errstate(invalid="ignore"):
        ends = np.quantile(draws[~np.isnan(draws)], (tail, 1.0 - tail))
    low, high = np.where(np.isnan(ends), np.inf, ends)  # numpy's value between two infinite ratios is NaN
    return float(low), float(high)


def jeffreys_interval(hits: float, n: float) -> tuple[float, float]:
    """Jeffreys' 95 % interval of a share: quantiles of Beta(hits + ½, n − hits + ½).

    The lower end is 0 without hits, the upper end 1 without misses.
    """
    low, high = _binomial_interval(hits, n, "jeffreys")
    return (0.0 if hits == 0 else low), (1.0 if hits == n else high)


def rate_ratio_interval(a: Clusters, b: Clusters, *, seed: int = 0) -> tuple[float, float]:
    """95 % interval of the ratio of two rates on the same clusters; either rate may be 0.

    Each rate is drawn from its Jeffreys posterior Beta(k/D + ½, (n − k)/D + ½), with k hits in n episodes and the
    larger design effect D of the two sides. A rate of 0 therefore has a spread, too. As in `jeffreys_interval` the ends
    are closed: without a hit in `a` the interval starts at 0, without one in `b` it has no upper end.
    """
    names = sorted(a.keys() & b.keys())
    if len(names) < 2:
        return 0.0, np.inf
    sides = [[np.array(one[name], float) for name in names] for one in (a, b)]
    effect, rng = max(map(design_effect, sides)), np.random.default_rng([seed, 1])
    hits, n = (np.array([[f(np.concatenate(side)) / effect] for side in sides]) for f in (np.sum, len))
    ours, theirs = rng.beta(hits + 0.5, n - hits + 0.5, size=(2, N_RESAMPLES))
    low, high = percentile_interval(ours / theirs, len(names))
    return (low if hits[0, 0] else 0.0), (high if hits[1, 0] else np.inf)


def design_effect(clusters: Sequence[Array]) -> float:
    """Design effect D ≥ 1: variance of a rate over clusters relative to as many independent episodes (Kish 1965).

    D = n var(p)/(p(1 − p)) with var(p) = m/(m − 1) Σ(k_i − p n_i)²/n² over m clusters with k_i hits in n_i episodes.
    If no value differs, or if there is a single cluster, D cannot be estimated and is 1.
    """
    hits, n = (np.array([f(one) for one in clusters], float) for f in (np.sum, len))
    share, count = hits.sum() / n.sum(), len(clusters)
    if not 0.0 < share < 1.0 or count < 2:
        return 1.0
    variance = count / (count - 1) * np.sum((hits - share * n) ** 2) / n.sum() ** 2
    return max(1.0, float(variance * n.sum() / (share * (1.0 - share))))


@dataclass(frozen=True, slots=True, kw_only=True)
class PairedComparison:
    """Comparison of `a` with `b` on common clusters: an effect with its interval, two tests, two effect sizes.

    `p` is the two-sided p value of a sign-flip permutation test of the differences of cluster means, `wilcoxon` that of
    the signed-rank test. `dz` is the mean difference over its standard deviation, `rank_biserial` is in [−1, 1].
    """

    effect: float
    low: float
    high: float
    p: float
    wilcoxon: float
    dz: float
    rank_biserial: float
    clusters: int

    @property
    def is_identical(self) -> bool:
        """Whether no cluster differs."""
        return bool(self.clusters) and math.isnan(self.dz) and not self.rank_biserial


NO_COMPARISON = PairedComparison(
    effect=math.nan,
    low=math.nan,
    high=math.nan,
    p=math.nan,
    wilcoxon=math.nan,
    dz=math.nan,
    rank_biserial=math.nan,
    clusters=0,
)
"""The result without a common cluster."""


def compare(a: Clusters, b: Clusters, effect: Callable[[Array, Array], Array], *, seed: int = 0) -> PairedComparison:
    """Compare `a` with `b`: `effect(mean of a, mean of b)`, with an interval from resampling the common clusters.

    Args:
        a: Values by cluster.
        b: Values by cluster; only clusters with values on both sides count.
        effect: `difference` or `ratio`.
        seed: Seed of the resampling and of the sign-flip test.
    """
    names = sorted(name for name in a.keys() & b.keys() if len(a[name]) and len(b[name]))
    if not names:
        return NO_COMPARISON
    ours, theirs = ([np.array(one[name], float) for name in names] for one in (a, b))
    # the same seed and count: both sides resample the same clusters
    draws = effect(_bootstrap_means(ours, seed), _bootstrap_means(theirs, seed))
    whole = effect(*(np.array([np.concatenate(one).mean()]) for one in (ours, theirs)))
    differences = np.array([x.mean() - y.mean() for x, y in zip(ours, theirs, strict=True)])
    low, high = percentile_interval(draws, len(names)) if len(names) > 1 else (-np.inf, np.inf)
    sd = float(differences.std(ddof=1)) if len(names) > 1 else 0.0
    return PairedComparison(
        effect=float(whole[0]),
        low=low,
        high=high,
        p=sign_flip_p(differences, seed=seed),
        wilcoxon=wilcoxon_p(differences),
        dz=float(differences.mean()) / sd if sd else float("nan"),
        rank_biserial=rank_biserial(differences),
        clusters=len(names),
    )


def difference(a: Array, b: Array) -> Array:
    """A − b."""
    return a - b


def ratio(a: Array, b: Array) -> Array:
    """A / b; 1 where both are 0, infinite where only b is 0."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(b > 0.0, a / np.where(b > 0.0, b, 1.0), np.where(a > 0.0, np.inf, 1.0))


def sign_flip_p(differences: Array, *, seed: int = 0) -> float:
    """Two-sided p value of a mean of 0 under random signs; exact up to 16 values, else from `N_SIGN_DRAWS` patterns."""
    d = np.asarray(differences, float)
    if len(d) < 2 or not np.any(d):  # a single value is as large with either sign
        return 1.0
    found = stats.permutation_test(
        (d,),
        lambda signed, axis: np.abs(signed.sum(axis=axis)),
        permutation_type="samples",
        alternative="greater",
        vectorized=True,
        n_resamples=N_SIGN_DRAWS,
        batch=SIGN_BATCH,
        rng=np.random.default_rng([seed, len(d)]),
    )
    return float(found.pvalue)


def wilcoxon_p(differences: Array) -> float:
    """Two-sided p value of Wilcoxon's signed-rank test; 1 if all differences are 0."""
    d = np.asarray(differences, float)
    return float(np.asarray(stats.wilcoxon(d))[1]) if np.any(d) else 1.0


def rank_biserial(differences: Array) -> float:
    """Matched-pairs rank-biserial correlation: (ranks of gains − ranks of losses)/all ranks; 0 if all are 0."""
    d = np.asarray(differences, float)
    d = d[d != 0.0]
    ranks = stats.rankdata(np.abs(d))
    return float((ranks[d > 0].sum() - ranks[d < 0].sum()) / ranks.sum()) if len(d) else 0.0


def holm_correction(p: Sequence[float]) -> list[float]:
    """P values corrected by Holm's step-down method; NaN stays NaN and is not counted."""
    from statsmodels.stats.multitest import multipletests  # noqa: PLC0415  (heavy imports are lazy)

    values = np.array(p, float)
    known = ~np.isnan(values)
    if known.any():
        values[known] = np.asarray(multipletests(values[known], method="holm")[1], float)
    return values.tolist()
