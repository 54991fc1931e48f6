"""Statistics of paired differences in scenes: questions of one scene are not independent, so the scene is the unit.

The methods are those of the evaluation (docs/explanation/statistics.md), which this package cannot import.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from statistics import NormalDist

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
N_RESAMPLES = 2000
CONFIDENCE_LEVEL = 0.95
MAX_EXACT_SCENES = 16
"""Up to this number of scenes all sign patterns are counted."""
N_SIGN_DRAWS = 9_999
"""Number of drawn sign patterns of more scenes."""
ROUNDING = 1e-9
"""Relative rounding error of a sum that equals the observed one."""


def scene_interval(scenes: Sequence[Array], rng: np.random.Generator) -> tuple[float, float]:
    """95 % interval of the mean of all values: bootstrap over `scenes`, of which there are at least two.

    The percentiles are expanded for few scenes (Hesterberg 2015, 4.3): with n scenes the tails are
    Φ(−sqrt(n/(n−1)) t_{0.975, n−1}).
    """
    from scipy.special import stdtrit  # noqa: PLC0415  (heavy imports are lazy)

    n = len(scenes)
    sums, counts = (np.array([f(one) for one in scenes], float) for f in (np.sum, len))
    chosen = rng.integers(n, size=(N_RESAMPLES, n))
    means = sums[chosen].sum(axis=1) / counts[chosen].sum(axis=1)
    wide = math.sqrt(n / (n - 1)) * float(stdtrit(n - 1, 0.5 * (1.0 + CONFIDENCE_LEVEL)))
    tail = NormalDist().cdf(-wide)
    low, high = np.quantile(means, (tail, 1.0 - tail))
    return float(low), float(high)


def sign_flip_p(scenes: Sequence[Array], rng: np.random.Generator) -> float:
    """Two-sided p value of a mean of 0: how often random signs of the scenes give a sum that is as far from 0.

    If both sides are equally good, the difference of each scene is symmetric about 0, however its questions depend on
    each other. The level therefore holds for every number of scenes.
    """
    sums = np.array([one.sum() for one in scenes], float)
    observed = abs(sums.sum()) * (1.0 - ROUNDING)
    if len(sums) <= MAX_EXACT_SCENES:
        patterns = np.arange(2 ** len(sums))[:, None] >> np.arange(len(sums)) & 1
        return float(np.mean(np.abs((1.0 - 2.0 * patterns) @ sums) >= observed))
    signs = rng.choice((-1.0, 1.0), size=(N_SIGN_DRAWS, len(sums)))
    return float((1 + np.count_nonzero(np.abs(signs @ sums) >= observed)) / (1 + N_SIGN_DRAWS))
