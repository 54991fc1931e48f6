import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import binomtest

from experiments.figures.tables import format_proportion, markdown_table, wilson_interval


@given(st.integers(1, 500), st.data())
def test_wilson_agrees_with_scipy(n, data):
    k = data.draw(st.integers(0, n))
    oracle = binomtest(k, n).proportion_ci(0.95, method="wilson")
    assert wilson_interval(k, n) == pytest.approx((oracle.low, oracle.high), abs=1e-6)


def test_without_trials_nothing_is_known():
    assert wilson_interval(0, 0) == (0.0, 1.0)
    assert format_proportion(0, 0) == "none yet"


def test_a_cell_cannot_break_its_table():
    assert markdown_table(("a",), [("x|y",)]) == ["| a |", "| --- |", "| x/y |", ""]
