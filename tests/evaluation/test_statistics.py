"""Intervals and tests compared with scipy, with hand calculations, and by their coverage in simulations."""

import gc
from itertools import product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from dualbrain.evaluation.analysis.statistics import (
    compare,
    design_effect,
    difference,
    effective_sample_size,
    estimate,
    holm_correction,
    jeffreys_interval,
    korn_graubard_interval,
    percentile_interval,
    rank_biserial,
    rate_ratio_interval,
    ratio,
    sign_flip_p,
    wilcoxon_p,
)


def clusters(values):
    return {f"run {number}": list(one) for number, one in enumerate(values)}


def test_mean_and_deviation_are_those_of_all_values():
    found = estimate(clusters([[1.0, 2.0], [4.0], [5.0, 9.0]]))
    assert (found.mean, found.n, found.clusters) == (4.2, 5, 3)
    assert found.sd == pytest.approx(np.std([1, 2, 4, 5, 9], ddof=1))


def test_with_one_value_a_cluster_the_interval_is_scipys_bootstrap():
    """With Hesterberg's expansion, which is a level whose plain percentiles are as wide."""
    values = np.random.default_rng(3).gamma(2.0, size=40)
    found = estimate(clusters(values[:, None]))
    level = 2 * stats.norm.cdf(np.sqrt(40 / 39) * stats.t(39).ppf(0.975)) - 1
    oracle = stats.bootstrap(
        (values,), np.mean, confidence_level=level, method="percentile", n_resamples=9999, rng=1
    ).confidence_interval
    assert 0.95 < level < 0.97
    assert (found.low, found.high) == pytest.approx((oracle.low, oracle.high), rel=0.03)


def test_clusters_are_drawn_not_values():
    """Ten copies of each value add no information; drawing values would narrow the interval threefold."""
    values = np.random.default_rng(5).normal(size=20)
    once, often = (estimate(clusters(np.repeat(values[:, None], k, axis=1))) for k in (1, 10))
    assert (once.low, once.high) == pytest.approx((often.low, often.high))


def test_the_bootstrap_interval_covers_the_truth():
    rng = np.random.default_rng(8)
    hits = 0
    for _ in range(150):
        truth = rng.normal(size=30)[:, None] + 0.5 * rng.normal(size=(30, 4))
        found = estimate(clusters(truth))
        hits += found.low <= 0.0 <= found.high
    assert 0.88 <= hits / 150 <= 0.99


def test_the_interval_of_five_clusters_covers_the_truth():
    """Plain percentiles of five values cover 84 %, the expanded ones about 90 %."""
    rng, hits = np.random.default_rng(11), 0
    for _ in range(400):
        found = estimate(clusters(rng.normal(size=(5, 1))))
        hits += found.low <= 0.0 <= found.high
    assert hits / 400 >= 0.88
    draws = np.arange(1001.0)
    assert percentile_interval(draws, 2) == pytest.approx((0.0, 1000.0), abs=0.5)
    assert percentile_interval(draws, 10_000) == pytest.approx((25.0, 975.0), abs=0.5)


def test_jeffreys_interval_is_that_of_its_posterior():
    assert jeffreys_interval(7, 20) == pytest.approx(tuple(stats.beta(7.5, 13.5).ppf([0.025, 0.975])))
    assert jeffreys_interval(0, 40) == (0.0, pytest.approx(stats.beta(0.5, 40.5).ppf(0.975)))
    assert jeffreys_interval(40, 40)[1] == 1.0


def hits_in_clusters(*hits, n_clusters=40, size=10):
    """Clusters of `size` episodes, of which the first have `hits` hits."""
    values = np.zeros((n_clusters, size))
    for cluster, count in enumerate(hits):
        values[cluster, :count] = 1.0
    return list(values)


def test_korn_graubard_is_clopper_pearson_at_the_effective_sample_size():
    """Four hits in two of forty clusters, by the formulas of the paper."""
    values = hits_in_clusters(3, 1)
    p, m, n = 0.01, 40, 400
    variance = m / (m - 1) * ((3 - 0.1) ** 2 + (1 - 0.1) ** 2 + 38 * 0.1**2) / n**2
    n_star = p * (1 - p) / variance * (stats.t(n - 1).ppf(0.975) / stats.t(m - 1).ppf(0.975)) ** 2
    assert effective_sample_size(values) == pytest.approx(n_star)
    low = stats.beta(p * n_star, n_star - p * n_star + 1).ppf(0.025)
    high = stats.beta(p * n_star + 1, n_star - p * n_star).ppf(0.975)
    assert korn_graubard_interval(values) == pytest.approx((low, high))


def test_the_effective_sample_size_is_at_most_the_sample_size():
    """Hits that are spread more evenly than at random would give more."""
    values = hits_in_clusters(*[1] * 20, n_clusters=40, size=2)
    assert design_effect(values) == 1.0
    assert effective_sample_size(values) < 80


def test_without_hits_each_cluster_counts_once():
    """Five equal episodes in each of four scenes are four trials; the upper end solves (1 − p)^4 = 0.025."""
    found = estimate(clusters([[0.0] * 5] * 4), is_rate=True)
    assert (found.low, found.high) == (0.0, pytest.approx(1 - 0.025 ** (1 / 4)))
    assert estimate(clusters([[1.0] * 5] * 4), is_rate=True).low == pytest.approx(1.0 - found.high)
    assert estimate(clusters([[0.0] * 5]), is_rate=True).high == pytest.approx(0.975)


@pytest.mark.parametrize("hits", range(1, 11))
def test_hits_in_a_single_cluster_do_not_narrow_the_interval(hits):
    """A single cluster gives no estimate of the variance between clusters."""
    none, some = (korn_graubard_interval(hits_in_clusters(count)) for count in (0, hits))
    assert some[1] > none[1]
    assert 0.0 < some[0] < hits / 400


@pytest.mark.parametrize(("icc", "p"), [(0.0, 0.005), (0.2, 0.01), (0.2, 0.02), (0.5, 0.02), (0.5, 0.05), (0.9, 0.01)])
def test_the_interval_of_a_rare_rate_covers_the_truth(icc, p):
    """Beta-binomial clusters; docs/explanation/statistics.md has the whole table."""
    rng, covered = np.random.default_rng(12), 0
    for _ in range(300):
        rates = rng.beta(p * (1 / icc - 1), (1 - p) * (1 / icc - 1), size=(40, 1)) if icc else np.full((40, 1), p)
        found = estimate(clusters((rng.random((40, 10)) < rates).astype(float)), is_rate=True)
        covered += found.low <= p <= found.high
    assert covered / 300 >= 0.90


def test_the_interval_of_a_rate_covers_the_truth_if_few_scenes_fail():
    """One scene in twenty is bad, and half of its ten episodes fail; with and without resampling."""
    rng, covered = np.random.default_rng(12), 0
    for _ in range(300):
        bad = rng.random((40, 1)) < 0.05
        found = estimate(clusters((rng.random((40, 10)) < np.where(bad, 0.5, 0.0)).astype(float)), is_rate=True)
        covered += found.low <= 0.025 <= found.high
    assert covered / 300 >= 0.93


def test_a_share_that_is_not_a_rate_has_no_binomial_interval():
    """An intervention frequency of 0 in every run is a number without spread."""
    found = estimate(clusters([[0.0] * 5] * 4))
    assert (found.low, found.high) == (-np.inf, np.inf)


def test_one_cluster_gives_no_interval_of_a_number():
    found = estimate(clusters([[1.5, 2.5, 9.0]]))
    assert (found.low, found.high) == (-np.inf, np.inf)
    assert np.isnan(estimate({}).mean)


def test_the_interval_of_a_ratio_of_rates_is_that_of_katz_for_many_hits():
    """For many hits the log of the ratio is normal (Katz)."""
    some, many = (clusters([[1.0] * k + [0.0] * (10 - k)] * 300) for k in (1, 4))
    low, high = rate_ratio_interval(some, many)  # equal clusters add no variance
    spread = np.sqrt(1 / 300 - 1 / 3000 + 1 / 1200 - 1 / 3000)
    assert (low, high) == pytest.approx((0.25 * np.exp(-1.96 * spread), 0.25 * np.exp(1.96 * spread)), rel=0.05)


def test_the_ratio_of_a_rate_of_zero_has_an_interval():
    none, often = clusters([[0.0] * 10] * 10), clusters([[1.0] * 6 + [0.0] * 4] * 10)
    low, high = rate_ratio_interval(none, often)
    assert low == 0.0 < 0.03 < high < 0.1
    assert 10.0 < rate_ratio_interval(often, none)[0] < rate_ratio_interval(often, none)[1] == np.inf
    assert rate_ratio_interval({"x": [0.0]}, {"x": [1.0]}) == (0.0, np.inf)


def test_the_ratio_of_rates_accounts_for_violations_in_few_scenes():
    """Four of forty scenes in which every episode fails are four observations, not forty."""
    none = clusters([[0.0] * 10] * 40)
    few, spread = clusters([[1.0] * 10] * 4 + [[0.0] * 10] * 36), clusters([[1.0] + [0.0] * 9] * 40)
    assert rate_ratio_interval(none, few)[1] > 2.0 * rate_ratio_interval(none, spread)[1]


def test_the_design_effect_of_copies_is_their_number():
    """Independent episodes have a design effect of 1, up to chance."""
    rng = np.random.default_rng(3)
    own = (rng.random((200, 1)) < 0.3).astype(float)
    assert design_effect(list(np.repeat(own, 8, axis=1))) == pytest.approx(8.0, rel=0.02)
    assert design_effect(list((rng.random((200, 8)) < 0.3).astype(float))) < 1.4
    assert design_effect(list(np.zeros((20, 8)))) == 1.0
    some = clusters(np.repeat(own, 8, axis=1))
    none, copied = clusters(np.zeros((200, 8))), clusters(np.zeros((200, 1)))
    assert rate_ratio_interval(none, some) == pytest.approx(rate_ratio_interval(copied, clusters(own)), rel=0.05)


def test_the_interval_of_a_ratio_covers_the_truth_if_violations_are_clustered():
    """Ten episodes in each of forty scenes; in a bad scene all fail, in the others one in twenty."""
    rng, covered = np.random.default_rng(4), 0
    for _ in range(200):
        bad = rng.random((40, 1)) < 0.2
        theirs = rng.random((40, 10)) < np.where(bad, 1.0, 0.05)
        ours = rng.random((40, 10)) < np.where(bad, 0.2, 0.01)
        low, high = rate_ratio_interval(clusters(ours.astype(float)), clusters(theirs.astype(float)))
        covered += low <= (0.2 * 0.2 + 0.8 * 0.01) / (0.2 + 0.8 * 0.05) <= high
    assert covered / 200 >= 0.93


def test_methods_are_compared_on_the_same_clusters():
    """The difficulty of a scene cancels: the interval of the difference is far narrower than that of either side."""
    rng = np.random.default_rng(1)
    difficulty = 10.0 * rng.normal(size=20)
    a, b = difficulty + 1.0 + 0.1 * rng.normal(size=20), difficulty
    found = compare(clusters(a[:, None]), clusters(b[:, None]), difference)
    assert 0.9 < found.low < found.effect < found.high < 1.1
    assert found.dz == pytest.approx(np.mean(a - b) / np.std(a - b, ddof=1))


def test_a_ratio_with_a_denominator_of_zero_has_no_upper_end():
    found = compare(clusters([[1.0], [0.0], [0.0], [2.0]]), clusters([[0.0], [0.0], [0.0], [1.0]]), ratio)
    assert (found.effect, found.high) == (3.0, np.inf)
    assert 1.0 <= found.low <= 3.0


def test_only_common_clusters_count():
    found = compare({"x": [2.0], "y": [4.0], "z": [100.0]}, {"x": [1.0], "y": [1.0]}, ratio)
    assert (found.effect, found.clusters) == (3.0, 2)
    assert compare({"x": [1.0]}, {"y": [1.0]}, ratio).clusters == 0


def test_the_sign_flip_test_counts_all_sign_patterns_of_few_values():
    d = np.array([0.3, -0.1, 0.8, 0.4, -0.2, 0.5, 0.9])
    sums = [sum(s * x for s, x in zip(signs, d, strict=True)) for signs in product((-1, 1), repeat=7)]
    assert sign_flip_p(d) == np.mean(np.abs(sums) >= abs(d.sum()) - 1e-12)
    oracle = stats.permutation_test((d, np.zeros(7)), lambda x, y: np.mean(x - y), permutation_type="samples")
    assert sign_flip_p(d) == pytest.approx(oracle.pvalue)
    long = np.random.default_rng(2).normal(0.3, size=25)
    drawn = stats.permutation_test(
        (long, np.zeros(25)), lambda x, y: np.mean(x - y), permutation_type="samples", n_resamples=9999, rng=4
    )
    assert sign_flip_p(long) == pytest.approx(drawn.pvalue, abs=0.02)


def test_the_sign_flip_test_keeps_its_level():
    rng = np.random.default_rng(6)
    assert np.mean([sign_flip_p(rng.normal(size=9)) < 0.1 for _ in range(300)]) == pytest.approx(0.1, abs=0.05)


def test_the_signed_rank_test_and_its_effect_size():
    d = np.array([1.0, 2.0, -3.0, 4.0, 5.0])
    assert wilcoxon_p(d) == stats.wilcoxon(d).pvalue
    assert rank_biserial(d) == pytest.approx((1 + 2 + 4 + 5 - 3) / 15)
    assert (wilcoxon_p(np.zeros(4)), rank_biserial(np.zeros(4)), sign_flip_p(np.zeros(4))) == (1.0, 0.0, 1.0)
    assert sign_flip_p(np.array([0.7])) == 1.0


def test_holm_by_hand():
    assert holm_correction([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    nan = float("nan")
    assert holm_correction([0.02, nan, 0.5]) == pytest.approx([0.04, nan, 0.5], nan_ok=True)
    assert np.isnan(holm_correction([nan])).all()


@pytest.fixture(scope="module")
def _frozen_objects():
    """Exempt the objects of the process from garbage collection, which every call of statsmodels starts."""
    gc.freeze()
    yield
    gc.unfreeze()


@pytest.mark.usefixtures("_frozen_objects")
@settings(max_examples=50)
@given(st.lists(st.floats(0.0, 1.0), min_size=1, max_size=12))
def test_holm_raises_p_values_keeps_their_order_and_stays_below_one(p):
    corrected = np.array(holm_correction(p))
    assert (corrected >= np.array(p) - 1e-12).all()
    assert (corrected <= 1.0).all()
    assert (np.diff(corrected[np.argsort(p, kind="stable")]) >= -1e-12).all()
    assert corrected.min() <= min(1.0, len(p) * min(p)) + 1e-12
