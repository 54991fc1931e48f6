"""Intervals and tests against scipy, counting by hand, and how often they are wrong."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from dualbrain.evaluation.analysis.statistics import (
    compare,
    design_effect,
    difference,
    estimate,
    holm_correction,
    jeffreys_interval,
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
    """Expanded as Hesterberg has it: by the level whose plain percentiles are as wide."""
    values = np.random.default_rng(3).gamma(2.0, size=40)
    found = estimate(clusters(values[:, None]))
    level = 2 * stats.norm.cdf(np.sqrt(40 / 39) * stats.t(39).ppf(0.975)) - 1
    oracle = stats.bootstrap(
        (values,), np.mean, confidence_level=level, method="percentile", n_resamples=9999, rng=1
    ).confidence_interval
    assert 0.95 < level < 0.97
    assert (found.low, found.high) == pytest.approx((oracle.low, oracle.high), rel=0.03)


def test_clusters_are_drawn_not_values():
    """Ten copies of each value say no more than one: drawing values would narrow the interval threefold."""
    values = np.random.default_rng(5).normal(size=20)
    once, often = (estimate(clusters(np.repeat(values[:, None], k, axis=1))) for k in (1, 10))
    assert (once.low, once.high) == pytest.approx((often.low, often.high))


def test_the_interval_holds_the_truth_as_often_as_it_says():
    rng = np.random.default_rng(8)
    hits = 0
    for _ in range(150):
        truth = rng.normal(size=30)[:, None] + 0.5 * rng.normal(size=(30, 4))
        found = estimate(clusters(truth))
        hits += found.low <= 0.0 <= found.high
    assert 0.88 <= hits / 150 <= 0.99


def test_few_clusters_are_covered_as_many_are():
    """Plain percentiles of five things cover 84 %, these some 90 %."""
    rng, hits = np.random.default_rng(11), 0
    for _ in range(400):
        found = estimate(clusters(rng.normal(size=(5, 1))))
        hits += found.low <= 0.0 <= found.high
    assert hits / 400 >= 0.88
    draws = np.arange(1001.0)
    assert percentile_interval(draws, 2) == pytest.approx((0.0, 1000.0), abs=0.5)
    assert percentile_interval(draws, 10_000) == pytest.approx((25.0, 975.0), abs=0.5)


def test_a_share_without_spread_has_jeffreys_interval():
    """Of clusters: what is alike five times in each of four scenes was seen four times."""
    found = estimate(clusters([[0.0] * 5] * 4), is_rate=True)
    assert (found.low, found.high) == (0.0, pytest.approx(stats.beta(0.5, 4.5).ppf(0.975)))
    assert estimate(clusters([[1.0] * 5] * 4), is_rate=True).low == pytest.approx(1.0 - found.high)
    assert jeffreys_interval(7, 20) == pytest.approx(tuple(stats.beta(7.5, 13.5).ppf([0.025, 0.975])))


def rare(hits, per, clusters=40, size=10):
    """`hits` episodes, `per` of them in a cluster."""
    told = np.zeros((clusters, size))
    for hit in range(hits):
        told[hit // per, hit % per] = 1.0
    return {str(number): list(one) for number, one in enumerate(told)}


@pytest.mark.parametrize("per", [1, 2, 10])
def test_one_hit_more_does_not_look_far_safer(per):
    """Whether in a scene of its own or where one was already. Somewhat it may: it tells that not all there go alike."""
    step = per if per == 10 else 1
    ends = [estimate(rare(step * hits, per), is_rate=True).high for hits in range(9)]
    assert ends[0] == pytest.approx(jeffreys_interval(0, 40)[1])
    assert all(after > 0.6 * before for before, after in pairwise(ends))


def test_a_rare_rate_holds_the_truth_as_often_as_it_says():
    """One scene in twenty is bad, and half of its ten episodes; where hits are resampled or not."""
    rng, held = np.random.default_rng(12), 0
    for _ in range(300):
        bad = rng.random((40, 1)) < 0.05
        found = estimate(clusters((rng.random((40, 10)) < np.where(bad, 0.5, 0.0)).astype(float)), is_rate=True)
        held += found.low <= 0.025 <= found.high
    assert held / 300 >= 0.93


def test_a_share_that_is_no_rate_is_no_trial():
    """An intervention frequency of 0 in every run is a number without spread."""
    found = estimate(clusters([[0.0] * 5] * 4))
    assert (found.low, found.high) == (-np.inf, np.inf)


def test_one_cluster_says_nothing_of_a_number():
    found = estimate(clusters([[1.5, 2.5, 9.0]]))
    assert (found.low, found.high) == (-np.inf, np.inf)
    assert np.isnan(estimate({}).mean)


def test_ratio_of_shares_by_posteriors_follows_the_known_one():
    """For many hits the log of the ratio is normal (Katz)."""
    some, many = (clusters([[1.0] * k + [0.0] * (10 - k)] * 300) for k in (1, 4))
    low, high = rate_ratio_interval(some, many)  # clusters that are all alike add nothing of their own
    spread = np.sqrt(1 / 300 - 1 / 3000 + 1 / 1200 - 1 / 3000)
    assert (low, high) == pytest.approx((0.25 * np.exp(-1.96 * spread), 0.25 * np.exp(1.96 * spread)), rel=0.05)


def test_a_share_of_zero_beside_another_is_not_none_at_all():
    none, often = clusters([[0.0] * 10] * 10), clusters([[1.0] * 6 + [0.0] * 4] * 10)
    low, high = rate_ratio_interval(none, often)
    assert low == 0.0 < 0.03 < high < 0.1
    assert 10.0 < rate_ratio_interval(often, none)[0] < rate_ratio_interval(often, none)[1] == np.inf
    assert rate_ratio_interval({"x": [0.0]}, {"x": [1.0]}) == (0.0, np.inf)


def test_a_ratio_of_shares_knows_that_violations_come_in_few_scenes():
    """Four scenes of forty in which everything goes wrong are four things that were seen, not forty."""
    none = clusters([[0.0] * 10] * 40)
    few, spread = clusters([[1.0] * 10] * 4 + [[0.0] * 10] * 36), clusters([[1.0] + [0.0] * 9] * 40)
    assert rate_ratio_interval(none, few)[1] > 2.0 * rate_ratio_interval(none, spread)[1]


def test_episodes_count_as_many_as_they_are_worth():
    """Copies are worth one; draws of their own are worth all, within what chance does."""
    rng = np.random.default_rng(3)
    own = (rng.random((200, 1)) < 0.3).astype(float)
    assert design_effect(list(np.repeat(own, 8, axis=1))) == pytest.approx(8.0, rel=0.02)
    assert design_effect(list((rng.random((200, 8)) < 0.3).astype(float))) < 1.4
    assert design_effect(list(np.zeros((20, 8)))) == 1.0
    some = clusters(np.repeat(own, 8, axis=1))
    none, copied = clusters(np.zeros((200, 8))), clusters(np.zeros((200, 1)))
    assert rate_ratio_interval(none, some) == pytest.approx(rate_ratio_interval(copied, clusters(own)), rel=0.05)


def test_a_ratio_holds_the_truth_as_often_as_it_says_where_violations_come_together():
    """Ten episodes in each of forty scenes; in a scene all go wrong, or one in twenty does."""
    rng, held = np.random.default_rng(4), 0
    for _ in range(200):
        bad = rng.random((40, 1)) < 0.2
        theirs = rng.random((40, 10)) < np.where(bad, 1.0, 0.05)
        ours = rng.random((40, 10)) < np.where(bad, 0.2, 0.01)
        low, high = rate_ratio_interval(clusters(ours.astype(float)), clusters(theirs.astype(float)))
        held += low <= (0.2 * 0.2 + 0.8 * 0.01) / (0.2 + 0.8 * 0.05) <= high
    assert held / 200 >= 0.93


def test_methods_are_compared_on_the_same_clusters():
    """What a scene makes hard cancels: the interval is that of the differences, far narrower than of either side."""
    rng = np.random.default_rng(1)
    hard = 10.0 * rng.normal(size=20)
    a, b = hard + 1.0 + 0.1 * rng.normal(size=20), hard
    found = compare(clusters(a[:, None]), clusters(b[:, None]), difference)
    assert 0.9 < found.low < found.effect < found.high < 1.1
    assert found.dz == pytest.approx(np.mean(a - b) / np.std(a - b, ddof=1))


def test_a_ratio_whose_denominator_is_often_nothing_has_no_upper_end():
    found = compare(clusters([[1.0], [0.0], [0.0], [2.0]]), clusters([[0.0], [0.0], [0.0], [1.0]]), ratio)
    assert (found.effect, found.high) == (3.0, np.inf)
    assert 1.0 <= found.low <= 3.0


def test_only_common_clusters_count():
    found = compare({"x": [2.0], "y": [4.0], "z": [100.0]}, {"x": [1.0], "y": [1.0]}, ratio)
    assert (found.effect, found.clusters) == (3.0, 2)
    assert compare({"x": [1.0]}, {"y": [1.0]}, ratio).clusters == 0


def test_sign_flip_is_scipys_permutation_test():
    d = np.array([0.3, -0.1, 0.8, 0.4, -0.2, 0.5, 0.9])
    oracle = stats.permutation_test((d, np.zeros(7)), lambda x, y: np.mean(x - y), permutation_type="samples")
    assert sign_flip_p(d) == pytest.approx(oracle.pvalue)
    long = np.random.default_rng(2).normal(0.3, size=25)
    drawn = stats.permutation_test(
        (long, np.zeros(25)), lambda x, y: np.mean(x - y), permutation_type="samples", n_resamples=9999, rng=4
    )
    assert sign_flip_p(long) == pytest.approx(drawn.pvalue, abs=0.02)


def test_sign_flip_keeps_its_level():
    rng = np.random.default_rng(6)
    assert np.mean([sign_flip_p(rng.normal(size=9)) < 0.1 for _ in range(300)]) == pytest.approx(0.1, abs=0.05)


def test_signed_rank_and_its_effect():
    d = np.array([1.0, 2.0, -3.0, 4.0, 5.0])
    assert wilcoxon_p(d) == stats.wilcoxon(d).pvalue
    assert rank_biserial(d) == pytest.approx((1 + 2 + 4 + 5 - 3) / 15)
    assert (wilcoxon_p(np.zeros(4)), rank_biserial(np.zeros(4)), sign_flip_p(np.zeros(4))) == (1.0, 0.0, 1.0)


def test_holm_by_hand():
    assert holm_correction([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    nan = float("nan")
    assert holm_correction([0.02, nan, 0.5])[0] == pytest.approx(0.04)


@given(st.lists(st.floats(0.0, 1.0), min_size=1, max_size=12))
def test_holm_corrects_upwards_keeps_order_and_stays_a_probability(p):
    corrected = np.array(holm_correction(p))
    assert (corrected >= np.array(p) - 1e-12).all()
    assert (corrected <= 1.0).all()
    assert (np.diff(corrected[np.argsort(p, kind="stable")]) >= -1e-12).all()
    assert corrected.min() <= min(1.0, len(p) * min(p)) + 1e-12
