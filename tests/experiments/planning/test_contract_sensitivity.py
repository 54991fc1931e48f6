"""The criteria on synthetic sweeps with known results."""

import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import spearmanr

from experiments.planning.contract_sensitivity import (
    DELTA_FLOOR,
    FAILURE_SCORE,
    best_fixed_regret,
    delta_ratios,
    evaluate_sensitivity,
    rank_correlations,
    scores_by_family,
)

values = st.one_of(st.floats(DELTA_FLOOR, 0.5), st.just(FAILURE_SCORE))


def row(seed, name, Delta, *, good=True, family="tall_ii", speed=0.2, valid=True, again=False):
    return {
        "family": family,
        "seed": seed,
        "parameters": {"speed": speed, "route": name},
        "valid": valid,
        "Delta": Delta,
        "outcome": "succeeded" if good else "taken_over",
        "truth": good,
        "again": again,
    }


@given(st.lists(st.tuples(values, values), min_size=3, max_size=12))
def test_spearman_agrees_with_scipy(pairs):
    first, second = (dict(enumerate(line)) for line in zip(*pairs, strict=True))
    found = rank_correlations({0: first, 1: second})
    if len(set(first.values())) == 1 or len(set(second.values())) == 1:
        assert found == []
    else:
        ranked = [[min(value, 9.0) for value in line.values()] for line in (first, second)]
        assert found == [pytest.approx(spearmanr(*ranked).statistic)]


@given(st.lists(st.lists(values, min_size=4, max_size=4), min_size=1, max_size=4))
def test_regret_is_never_negative_and_zero_for_one_seed(lines):
    scores = {seed: dict(zip("abcd", line, strict=True)) for seed, line in enumerate(lines)}
    _, failed, extra = best_fixed_regret(scores)
    assert 0.0 <= failed < 1.0
    assert extra >= 0.0
    _, failed, extra = best_fixed_regret({0: scores[0]})
    assert (failed, extra) == (0.0, 0.0)


def test_failures_rank_worst_and_small_interventions_count_as_the_floor():
    rows = [row(0, "a", 0.0), row(0, "b", 3e-4), row(0, "c", 0.0, good=False), row(0, "d", 0.0, valid=False)]
    scores = scores_by_family(rows)["tall_ii", 0.2]
    assert scores == {0: {"a": DELTA_FLOOR, "b": 3e-4, "c": FAILURE_SCORE}}
    assert delta_ratios(scores) == [pytest.approx(3.0)]


def test_the_criteria_are_met_if_seeds_differ_and_missed_if_one_contract_is_always_best():
    base = {"a": 1e-4, "b": 4e-4, "c": 9e-4}
    rows = [row(seed, name, Delta) for seed in (0, 1) for name, Delta in base.items()]
    rows += [row(seed, "d", 0.0, good=False) for seed in (0, 1)]
    rows += [row(0, name, 1.1 * Delta, again=True) for name, Delta in base.items()]
    (same,) = evaluate_sensitivity(rows)
    assert same.verdict_text == "missed: regret"
    (differs,) = evaluate_sensitivity([*rows, row(1, "b", 1e-4), row(1, "a", 4e-4)])
    assert differs.verdict_text == "met"
    assert differs.best_fixed in ("a", "b")
    assert differs.regret_delta > 0.0


def test_rankings_must_repeat_in_one_scene_not_between_scenes():
    rows = [row(seed, name, Delta) for seed in (0, 1) for name, Delta in (("a", 1e-4), ("b", 4e-4), ("c", 9e-4))]
    rows += [row(0, name, Delta, again=True) for name, Delta in (("a", 9e-4), ("b", 4e-4), ("c", 1e-4))]
    (shuffled,) = evaluate_sensitivity(rows)
    assert shuffled.noise_correlations == [pytest.approx(-1.0)]
    assert shuffled.cross_scene_correlations == [pytest.approx(1.0)]
    assert not shuffled.criteria["repeats"]


def test_a_family_without_any_success_misses_all_criteria():
    (result,) = evaluate_sensitivity([row(seed, name, 0.0, good=False) for seed in (0, 1) for name in "ab"])
    assert result.verdict_text == "missed: threefold, repeats, success varies, regret"
    assert result.regret_text == "no contract succeeds"
    assert result.unsolved_text == "tall_ii:0, tall_ii:1"


def test_only_scenes_that_no_contract_solves_are_infeasible():
    good, hopeless = [row(0, name, 0.0, good=name == "a") for name in "ab"], [row(1, "a", 0.0, good=False)]
    assert [verdict.unsolved_seeds for verdict in evaluate_sensitivity(good)] == [[]]
    assert [verdict.unsolved_seeds for verdict in evaluate_sensitivity([*good, *hopeless])] == [[1]]
