"""Laws of the weight update: bounds, directions, order, and Proposition 2 of the paper."""

import math
from functools import reduce

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from dualbrain.errors import ConfigurationError
from dualbrain.memory.plasticity.affine_map import AffineMap
from dualbrain.memory.plasticity.hebbian_update import Penalty, Plasticity

ROUNDING = 4e-16
weights = st.floats(0.0, 1.0)
Deltas = st.one_of(st.none(), st.floats(0.0, 1e6), st.just(math.nan), st.just(math.inf))
outcomes = st.tuples(st.sampled_from((0, 1)), Deltas)


@st.composite
def rules(draw: st.DrawFn) -> Plasticity:
    rho = draw(st.one_of(st.just(0.0), st.floats(1e-3, 0.9)))
    g = Penalty(draw(st.floats(0.0, 1.0)), draw(st.floats(1e-4, 1.0)), draw(st.floats(0.0, 2.0)))
    eta_minus = draw(st.floats(0.0, 1.0))
    assume(rho > 0.0 or eta_minus * min(g.floor, g.rejected) >= 1e-3)
    eta_plus = max(rho, 1e-3) * draw(st.floats(1.0, 5.0))
    most = max(0.0, min(eta_plus - rho, eta_minus * min(g.floor, g.rejected)))
    kappa = draw(st.floats(0.0, min(1.0, most)))
    return Plasticity(
        rho=rho,
        eta_plus=eta_plus,
        eta_minus=eta_minus,
        epsilon=draw(st.floats(0.0, 0.1)),
        g=g,
        kappa=kappa,
        bandwidth=draw(st.floats(0.05, 0.3)),
    )


@given(rules(), weights, st.lists(outcomes, max_size=40))
def test_a_weight_stays_in_its_interval(rule: Plasticity, w: float, sequence: list[tuple[int, float | None]]) -> None:
    for r, Delta in sequence:
        w = rule.update_map(r, Delta)(w)
        assert 0.0 <= w <= 1.0


@given(rules(), weights, outcomes)
def test_success_never_lowers_and_failure_never_raises_a_weight(
    rule: Plasticity, w: float, outcome: tuple[int, float | None]
) -> None:
    after = rule.update_map(*outcome)(w)
    if rule.is_reinforcing(*outcome):
        assert after >= w - ROUNDING
    else:
        assert after <= w


@given(rules(), weights, weights, outcomes)
def test_the_update_preserves_the_order_of_weights(
    rule: Plasticity, a: float, b: float, outcome: tuple[int, float | None]
) -> None:
    update = rule.update_map(*outcome)
    assert update(min(a, b)) <= update(max(a, b))


@given(rules(), weights, st.floats(0.0, 1e3), st.floats(0.0, 1e3))
def test_more_intervention_never_suppresses_less(rule: Plasticity, w: float, a: float, b: float) -> None:
    assert rule.update_map(0, max(a, b))(w) <= rule.update_map(0, min(a, b))(w) + ROUNDING
    assert rule.update_map(1, max(a, b))(w) <= rule.update_map(1, min(a, b))(w) + ROUNDING


@given(rules(), weights, weights, st.lists(st.one_of(st.none(), st.floats(0.0, 10.0)), min_size=1, max_size=5))
def test_proposition_2(rule: Plasticity, good: float, bad: float, failures: list[float | None]) -> None:
    """From any initial weights, repeated success ends above repeated failure after a bounded number of updates.

    Each success reduces 1 - w at least by the factor (1 - rho) or by eta_plus; each failure reduces w by the factor
    (1 - rho) or by eta_minus·g.
    """
    slowest = max(rule.rho, rule.eta_minus * min(rule.g.floor, rule.g.rejected))
    updates = math.ceil(12.0 / min(slowest, max(rule.rho, rule.eta_plus)))
    reinforce = rule.update_map(1, 0.0)
    assume(updates <= 20_000)
    for k in range(updates):
        good = reinforce(good)
        bad = rule.update_map(0, failures[k % len(failures)])(bad)
    assert good - bad > 0.9


def test_the_rule_is_that_of_the_paper() -> None:
    rule = Plasticity(rho=0.1, eta_plus=0.2, eta_minus=0.3, epsilon=0.01, g=Penalty(floor=0.5, scale=0.1, rejected=0.9))
    assert rule.update_map(1, 0.01)(0.5) == pytest.approx(0.9 * 0.5 + 0.2)
    assert rule.update_map(1, 0.1)(0.5) == pytest.approx(0.9 * 0.5 - 0.3 * 0.75)
    assert rule.update_map(0, 0.0)(0.5) == pytest.approx(0.9 * 0.5 - 0.3 * 0.5)
    assert rule.update_map(0, None)(0.5) == pytest.approx(0.9 * 0.5 - 0.3 * 0.9)


def test_updates_do_not_commute() -> None:
    rule = Plasticity(eta_minus=0.4)
    up, down = rule.update_map(1, 0.0), rule.update_map(0, math.inf)

    def after(*updates: AffineMap) -> float:
        return reduce(lambda w, update: update(w), updates, 0.5)

    assert after(up, up, down, down) != after(down, down, up, up)


@pytest.mark.parametrize("Delta", [math.nan, math.inf, -math.inf, -1.0, None])
def test_a_success_without_a_valid_delta_is_not_reinforced(Delta: float | None) -> None:
    assert not Plasticity().is_reinforcing(1, Delta)
    assert Plasticity().update_map(1, Delta)(0.5) < 0.5
    assert Plasticity().update_map(1, Delta)(1.0) >= 0.95 - 0.2


@pytest.mark.parametrize(
    "setting",
    [
        {"rho": 0.1, "eta_plus": 0.05},
        {"rho": 0.0, "eta_plus": 0.0},
        {"rho": 0.0, "eta_minus": 0.0},
        {"rho": 0.0, "g": Penalty(floor=0.0)},
        {"rho": 0.0, "g": Penalty(rejected=0.0)},
        {"rho": 1.0, "eta_plus": 1.0},
        {"rho": -0.1},
        {"rho": math.nan},
        {"eta_plus": math.nan},
        {"eta_minus": math.inf},
        {"epsilon": -1.0},
        {"g": Penalty(scale=0.0)},
        {"g": Penalty(floor=1.5)},
    ],
)
def test_rules_without_proposition_2_are_refused(setting: dict[str, float]) -> None:
    with pytest.raises(ConfigurationError, match="plasticity"):
        Plasticity(**setting)
