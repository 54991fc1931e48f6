"""The simulated intervals are those of the libraries and of the reports."""

import numpy as np
import pytest
import statsmodels.api as sm

from dualbrain.evaluation.analysis.statistics import estimate
from experiments.evaluation.interval_coverage import (
    CLUSTER_SIZE,
    MARKER,
    METHODS,
    N_CLUSTERS,
    PAGE,
    coverage,
    draw_hits,
    gee,
    report_lines,
    reported,
)


def clusters_of(hits):
    """Episodes by cluster, from the hits of one sample."""
    return {str(k): list((np.arange(CLUSTER_SIZE) < count).astype(float)) for k, count in enumerate(hits)}


def test_the_gee_interval_is_that_of_statsmodels():
    hits = draw_hits(0.2, 0.5, 1)
    values = np.concatenate([clusters_of(hits[0])[str(k)] for k in range(N_CLUSTERS)])
    model = sm.GEE(
        values,
        np.ones((len(values), 1)),
        groups=np.repeat(np.arange(N_CLUSTERS), CLUSTER_SIZE),
        family=sm.families.Binomial(),
        cov_struct=sm.cov_struct.Exchangeable(),
    )
    logits = model.fit().conf_int()[0]
    assert gee(hits)[0] == pytest.approx(1.0 / (1.0 + np.exp(-logits)), rel=1e-6)


@pytest.mark.parametrize(("rate", "correlation"), [(0.01, 0.5), (0.2, 0.2)])
def test_the_simulated_interval_of_the_reports_is_that_of_the_reports(rate, correlation):
    hits = draw_hits(rate, correlation, 3)
    for sample, interval in zip(hits, reported(hits), strict=True):
        found = estimate(clusters_of(sample), is_rate=True)
        assert interval == pytest.approx((found.low, found.high), rel=0.03)


def test_hits_have_the_rate_and_the_correlation_of_their_distribution():
    for correlation in (0.0, 0.5):
        shares = draw_hits(0.2, correlation, 2000) / CLUSTER_SIZE
        variance = 0.2 * 0.8 / CLUSTER_SIZE * (1.0 + (CLUSTER_SIZE - 1) * correlation)
        assert shares.mean() == pytest.approx(0.2, abs=0.005)
        assert shares.var() == pytest.approx(variance, rel=0.05)


def test_an_interval_that_does_not_exist_covers_nothing():
    assert coverage(np.array([[np.nan, np.nan], [0.0, 0.4]]), 0.1) == (0.5, 0.4)


def test_the_report_has_a_row_for_each_rate_and_the_lowest_coverage():
    lines = report_lines(2)
    assert sum(line.startswith("| 0.005 |") for line in lines) == 4
    assert any(line.startswith("| lowest of all cells |") for line in lines)
    assert lines[2].count("|") == len(METHODS) + 3


def test_the_page_has_the_marker_and_a_table_for_each_correlation():
    text = PAGE.read_text(encoding="utf-8").partition(MARKER)[2]
    assert [line for line in text.splitlines() if line.startswith("### ICC")] == [
        "### ICC 0",
        "### ICC 0.2",
        "### ICC 0.5",
        "### ICC 0.9",
    ]
