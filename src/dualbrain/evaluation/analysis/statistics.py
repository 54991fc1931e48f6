"""Intervals and tests for paired, clustered episodes (paper 7.5).

Episodes of one run share a ledger, and episodes in one scene share its difficulty: runs (clusters) are drawn, not
episodes. Methods are compared on the same clusters, so that what a scene makes hard is subtracted.
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
MAX_EXACT_CLUSTERS, N_SIGN_DRAWS = 16, 99_999
"""Up to so many clusters all sign changes are counted; of more, so many are drawn."""
MIN_CLUSTERS_FOR_BOOTSTRAP = 5
"""A rate whose hits, or whose misses, lie in fewer clusters has too little to be resampled."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Estimate:
    """Mean ± standard deviation over `n` values of `clusters` clusters, with a 95 % interval; NaN without values."""

    mean: float
    sd: float
    low: float
    high: float
    n: int
    clusters: int


def estimate(values: Clusters, *, is_rate: bool = False, seed: int = 0) -> Estimate:
    """Mean over all values; the interval by a bootstrap over clusters.

    A `rate` (values 0 and 1) whose hits or misses lie in fewer than `FEW` clusters has Jeffreys' interval of as many
    trials as its episodes are worth (`trials`). Any other number of a single cluster, or that is the same everywhere,
    has no spread to draw from, and its interval is unbounded (−∞ to ∞).
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
    share, n = float(np.concatenate(clusters).mean()), effective_trials(clusters)
    return jeffreys_interval(share * n, n)


def effective_trials(clusters: Sequence[Array]) -> float:
    """What the episodes of a rate are worth: n/D with D = 1 + (n̄ − 1)ρ, n̄ episodes a cluster on average.

    ρ = (1 + mρ̂)/(1 + m) is the correlation within a cluster that the design effect tells, ρ̂, and that of one cluster
    more in which it is whole; m clusters hold a hit and a miss the less of. So what never happened in ten episodes of
    one scene was seen once not to happen, and what happened in one scene of many is not believed to be independent.
    """
    n, m = sum(map(len, clusters)), min(_hit_and_miss_clusters(clusters))
    size = n / len(clusters)
    seen = min((design_effect(clusters) - 1.0) / (size - 1.0), 1.0) if size > 1.0 else 0.0
    return n / (1.0 + (size - 1.0) * (1.0 + m * seen) / (1.0 + m))


def _hit_and_miss_clusters(clusters: Sequence[Array]) -> tuple[int, int]:
    """How many clusters hold a hit, and how many a miss."""
    return sum(bool(one.max()) for one in clusters), sum(not one.min() for one in clusters)


def _bootstrap_means(clusters: Sequence[Array], seed: int) -> Array:
    """Means of resampled clusters, (RESAMPLES,)."""
    sums, counts = (np.array([f(one) for one in clusters], float) for f in (np.sum, len))
    chosen = np.random.default_rng([seed, len(clusters)]).integers(len(clusters), size=(N_RESAMPLES, len(clusters)))
    return sums[chosen].sum(axis=1) / counts[chosen].sum(axis=1)


def percentile_interval(draws: Array, n: int) -> tuple[float, float]:
    """The 95 % interval of bootstrap draws from `n` things: percentiles, expanded for few (Hesterberg 2015, 4.3).

    Instead of α/2 the tails are Φ(−sqrt(n/(n−1)) t_{1−α/2, n−1}); plain percentiles of ten things cover some 89 %.
    """
    wide = np.sqrt(n / (n - 1)) * stats.t(n - 1).ppf(0.5 * (1.0 + CONFIDENCE_LEVEL))
    tail, told = float(stats.norm.cdf(-wide)), np.sort(draws[~np.isnan(draws)])
    return _quantile(told, tail), _quantile(told, 1.0 - tail)


def _quantile(ordered: Array, share: float) -> float:
    """The linear quantile of sorted draws; unlike numpy's it knows that nothing lies between infinity and itself."""
    place = share * (len(ordered) - 1)
    below, above = (float(ordered[step]) for step in (math.floor(place), math.ceil(place)))
    return below if below == above else below + (above - below) * (place - math.floor(place))


def jeffreys_interval(hits: float, n: float) -> tuple[float, float]:
    """Jeffreys' 95 % interval of a share: quantiles of Beta(hits + ½, n − hits + ½), with the ends closed."""
    beta, tail = stats.beta(hits + 0.5, n - hits + 0.5), 0.5 * (1.0 - CONFIDENCE_LEVEL)
    low, high = float(beta.ppf(tail)), float(beta.ppf(1.0 - tail))
    return (0.0 if hits == 0 else low), (1.0 if hits == n else high)


def rate_ratio_interval(a: Clusters, b: Clusters, *, seed: int = 0) -> tuple[float, float]:
    """The 95 % interval of the ratio of two shares on the same clusters, either of which may be 0.

    Each share is drawn from its Jeffreys posterior, Beta(k/D + ½, (n − k)/D + ½) with k hits of n: episodes count as
    many as they are worth where hits come together, n/D. So a share of 0 has a spread, too, and it is that of the
    scenes in which the other share was found. As with `jeffreys` the ends are closed: without a hit in `a` it begins at
    0, without one in `b` it never ends.
    """
    names = sorted(a.keys() & b.keys())
    if len(names) < 2:
        return 0.0, np.inf
    sides = [[np.array(one[name], float) for name in names] for one in (a, b)]
    worth, rng = max(map(design_effect, sides)), np.random.default_rng([seed, 1])
    hits, n = (np.array([[f(np.concatenate(side)) / worth] for side in sides]) for f in (np.sum, len))
    ours, theirs = rng.beta(hits + 0.5, n - hits + 0.5, size=(2, N_RESAMPLES))
    low, high = percentile_interval(ours / theirs, len(names))
    return (low if hits[0, 0] else 0.0), (high if hits[1, 0] else np.inf)


def design_effect(clusters: Sequence[Array]) -> float:
    """D ≥ 1: the variance of a share over clusters, as a multiple of that of as many independent episodes (Kish 1965).

    Where nothing differs, or of one cluster, it cannot be told, and is 1.
    """
    hits, n = (np.array([f(one) for one in clusters], float) for f in (np.sum, len))
    share, count = hits.sum() / n.sum(), len(clusters)
    if not 0.0 < share < 1.0 or count < 2:
        return 1.0
    spread = count / (count - 1) * np.sum((hits - share * n) ** 2) / n.sum() ** 2
    return max(1.0, float(spread * n.sum() / (share * (1.0 - share))))


@dataclass(frozen=True, slots=True, kw_only=True)
class PairedComparison:
    """One quantity of `a` against `b` on common clusters: an effect with its interval, a test, sizes.

    `p` is that of a sign-flip permutation of the differences of cluster means (two-sided), `wilcoxon` that of the
    signed-rank test; `dz` their mean over their standard deviation, `rank_biserial` in [−1, 1].
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
    """`how(mean of a, mean of b)` is the effect: a difference or a ratio; its interval by drawing common clusters."""
    names = sorted(name for name in a.keys() & b.keys() if len(a[name]) and len(b[name]))
    if not names:
        return NO_COMPARISON
    ours, theirs = ([np.array(one[name], float) for name in names] for one in (a, b))
    draws = effect(
        _bootstrap_means(ours, seed), _bootstrap_means(theirs, seed)
    )  # the same seed and count: the same clusters
    whole = effect(*(np.array([np.concatenate(one).mean()]) for one in (ours, theirs)))
    difference = np.array([x.mean() - y.mean() for x, y in zip(ours, theirs, strict=True)])
    low, high = percentile_interval(draws, len(names)) if len(names) > 1 else (-np.inf, np.inf)
    sd = float(difference.std(ddof=1)) if len(names) > 1 else 0.0
    return PairedComparison(
        effect=float(whole[0]),
        low=low,
        high=high,
        p=sign_flip_p(difference, seed=seed),
        wilcoxon=wilcoxon_p(difference),
        dz=float(difference.mean()) / sd if sd else float("nan"),
        rank_biserial=rank_biserial(difference),
        clusters=len(names),
    )


def difference(a: Array, b: Array) -> Array:
    """A − b."""
    return a - b


def ratio(a: Array, b: Array) -> Array:
    """A / b; 1 where both are 0, infinite where only b is."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(b > 0.0, a / np.where(b > 0.0, b, 1.0), np.where(a > 0.0, np.inf, 1.0))


def sign_flip_p(difference: Array, *, seed: int = 0) -> float:
    """Two-sided p of a mean that is 0 under random signs: exact for few values, else `SIGNS` draws and the data."""
    d = np.asarray(difference, float)
    if not len(d) or not np.any(d):
        return 1.0
    if len(d) <= MAX_EXACT_CLUSTERS:
        signs = 1.0 - 2.0 * ((np.arange(2 ** len(d))[:, None] >> np.arange(len(d))) & 1)
        return float(np.mean(np.abs(signs @ d) >= abs(d.sum()) - 1e-12))
    signs = np.random.default_rng([seed, len(d)]).choice((-1.0, 1.0), size=(N_SIGN_DRAWS, len(d)))
    return float((1 + np.sum(np.abs(signs @ d) >= abs(d.sum()) - 1e-12)) / (N_SIGN_DRAWS + 1))


def wilcoxon_p(difference: Array) -> float:
    """Two-sided p of Wilcoxon's signed-rank test; 1 where all differences are 0."""
    d = np.asarray(difference, float)
    return float(np.asarray(stats.wilcoxon(d))[1]) if np.any(d) else 1.0


def rank_biserial(difference: Array) -> float:
    """Matched-pairs rank-biserial correlation: (ranks of gains − ranks of losses) / all ranks; 0 where all are 0."""
    d = np.asarray(difference, float)
    d = d[d != 0.0]
    ranks = stats.rankdata(np.abs(d))
    return float((ranks[d > 0].sum() - ranks[d < 0].sum()) / ranks.sum()) if len(d) else 0.0


def holm_correction(p: Sequence[float]) -> list[float]:
    """P values corrected for their number by Holm's step-down method; NaN stays, and is not counted."""
    values = np.array(p, float)
    known = np.flatnonzero(~np.isnan(values))
    order = known[np.argsort(values[known])]
    corrected = values.copy()
    least = 0.0
    for place, index in enumerate(order):
        least = max(least, min(1.0, (len(known) - place) * values[index]))
        corrected[index] = least
    return corrected.tolist()
