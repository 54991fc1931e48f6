"""Verdicts on the hypotheses: the rule at its limits, and the three hypotheses on results with a known answer."""

import msgspec
import numpy as np
import pytest

from dualbrain.evaluation.analysis.hypotheses import (
    AT_LEAST,
    AT_MOST,
    claim_verdict,
    combine_all,
    combine_any,
    evaluate_hypotheses,
    pair_values,
    secondary_claims,
)
from dualbrain.evaluation.analysis.metrics import METRIC_BY_NAME
from dualbrain.evaluation.analysis.statistics import PairedComparison
from tests.evaluation.sample_rows import COLLISION, TOOL_SPEED, episode_row


def found(low, high, clusters=10):
    return PairedComparison(
        effect=0.5 * (low + high),
        low=low,
        high=high,
        p=0.01,
        wilcoxon=0.01,
        dz=1.0,
        rank_biserial=1.0,
        clusters=clusters,
    )


@pytest.mark.parametrize(
    ("low", "high", "side", "verdict"),
    [
        (0.05, 0.19, AT_MOST, "supported"),
        (0.05, 0.20, AT_MOST, "supported"),
        (0.05, 0.21, AT_MOST, "undecided"),
        (0.21, 0.90, AT_MOST, "refuted"),
        (0.20, 0.90, AT_MOST, "undecided"),
        (0.30, 0.90, AT_LEAST, "supported"),
        (0.10, 0.90, AT_LEAST, "undecided"),
        (0.0, 0.19, AT_LEAST, "refuted"),
    ],
)
def test_a_verdict_needs_the_whole_interval_on_one_side(low, high, side, verdict):
    assert claim_verdict(found(low, high), 0.2, side) == verdict


@pytest.mark.parametrize(("clusters", "verdict"), [(2, "undecided"), (5, "undecided"), (6, "supported")])
def test_few_clusters_decide_nothing(clusters, verdict):
    assert claim_verdict(found(0.0, 0.1, clusters=clusters), 0.2, AT_MOST) == verdict


def test_without_measurements_there_is_no_verdict():
    assert claim_verdict(found(0.0, 0.1, clusters=0), 0.2, AT_MOST) == "not measured"
    assert [result.verdict for result in evaluate_hypotheses([episode_row("B3")])] == ["not measured"] * 3


def test_verdicts_are_combined_by_all_or_by_any():
    assert combine_all(["supported", "supported"]) == "supported"
    assert combine_all(["supported", "refuted"]) == combine_all(["refuted", "not measured"]) == "refuted"
    assert combine_all(["supported", "undecided"]) == "undecided"
    assert combine_any(["refuted", "supported"]) == "supported"
    assert combine_any(["refuted", "undecided"]) == "undecided"
    assert combine_any(["refuted", "refuted"]) == "refuted"


def episodes(method, rate, runs=10, per=10, seed=0):
    """Episodes of which a share `rate` has a collision."""
    rng = np.random.default_rng([seed, sum(map(ord, method))])
    return [
        episode_row(method, run, seed=100 * run + k, violations=(COLLISION,) if rng.random() < rate else ())
        for run in range(runs)
        for k in range(per)
    ]


@pytest.mark.parametrize(
    ("rate", "verdict"), [(0.0, "supported"), (0.02, "supported"), (0.15, "undecided"), (0.55, "refuted")]
)
def test_h1_follows_the_violation_rate_of_the_filter(rate, verdict):
    rows = [*episodes("B1", 0.7), *episodes("B2", 0.6), *episodes("B3", rate)]
    assert evaluate_hypotheses(rows)[0].verdict == verdict


def test_h1_is_undecided_after_few_episodes_without_a_violation():
    few = [*episodes("B1", 0.5, 2, 3), *episodes("B2", 0.5, 2, 3), *episodes("B3", 0.0, 2, 3)]
    assert evaluate_hypotheses(few)[0].verdict == "undecided"


def repeated(method, factor, runs=10):
    """Ten repetitions of a scene per run; Δ of the second half is `factor` times that of the first half."""
    rng = np.random.default_rng([7, sum(map(ord, method))])
    return [
        episode_row(
            method, run, seed=run, repetition=k, Delta=0.01 * (factor if k >= 5 else 1.0) * rng.uniform(0.9, 1.1)
        )
        for run in range(runs)
        for k in range(10)
    ]


@pytest.mark.parametrize(("factor", "verdict"), [(0.5, "supported"), (1.0, "refuted"), (0.8, "undecided")])
def test_h2_compares_the_second_half_of_the_repetitions(factor, verdict):
    result = evaluate_hypotheses([*repeated("M", factor), *repeated("B4", 1.0)])[1]
    assert result.verdict == verdict
    assert result.claims[0].found.effect == pytest.approx(factor, rel=0.05)


def test_h2_counts_only_cases_in_which_both_succeed():
    rows = [*repeated("M", 0.5), *repeated("B4", 1.0)]
    fewer = [one for one in rows if (one.method, one.repetition) != ("M", 9)]
    failed = [episode_row("M", run, seed=run, repetition=9, Delta=5.0, success=False) for run in range(10)]
    assert evaluate_hypotheses([*fewer, *failed])[1].claims[0].found == evaluate_hypotheses(fewer)[1].claims[0].found


def adapted(method, compliance, frequency, runs=10):
    rng = np.random.default_rng([9, sum(map(ord, method))])
    return [
        episode_row(
            method,
            run,
            seed=10 * run + k,
            compliant=bool(rng.random() < compliance),
            frequency=frequency * rng.uniform(0.95, 1.05),
        )
        for run in range(runs)
        for k in range(10)
    ]


def test_h3_needs_both_comparisons_and_one_of_two_effects():
    base = [*adapted("M", 0.5, 0.3), *adapted("PE", 0.6, 0.3)]
    good = [*adapted("Full", 0.95, 0.3), *adapted("P", 0.6, 0.1)]
    assert evaluate_hypotheses([*base, *good])[2].verdict == "supported"
    half = [*adapted("Full", 0.95, 0.3), *adapted("P", 0.4, 0.3)]
    assert evaluate_hypotheses([*base, *half])[2].verdict == "refuted"


def test_h3_counts_the_frequency_of_contracts_on_task_only():
    """A planner that learned to move little avoids interventions without learning the task."""
    rows = [*adapted("M", 0.5, 0.3), *adapted("PE", 0.6, 0.3), *adapted("Full", 0.5, 0.3), *adapted("P", 0.6, 0.3)]
    idle = [
        msgspec.structs.replace(one, frequency=0.0, meant=one.seed % 2 == 0)
        if one.method in ("Full", "P") and one.seed % 2
        else one
        for one in rows
    ]
    found = [claim for claim in evaluate_hypotheses(idle)[2].claims if "frequency" in claim.quantity]
    assert [claim.found.effect for claim in found] == pytest.approx([1.0, 1.0], abs=0.02)


def test_h3_uses_unconstrained_answers_if_a_suite_asks_for_them():
    """Constrained answers that all comply are not informative; the unconstrained answers decide."""
    bound = [one for name in ("M", "PE", "Full", "P") for one in adapted(name, 1.0, 0.3, runs=40)]
    assert evaluate_hypotheses(bound)[2].verdict == "refuted"
    free = [msgspec.structs.replace(one, free_compliant=one.method in ("Full", "P")) for one in bound]
    found = evaluate_hypotheses(free)[2]
    assert (found.verdict, found.claims[0].quantity) == ("supported", "free one-shot compliance")
    few = [msgspec.structs.replace(one, free_compliant=None) if one.seed % 2 else one for one in free]
    assert evaluate_hypotheses(few)[2].claims[0].found.effect == 1.0


def test_h3_ignores_unconstrained_answers_of_methods_that_it_does_not_compare():
    rows = [*adapted("M", 0.3, 0.3), *adapted("PE", 0.3, 0.3), *adapted("Full", 0.9, 0.3), *adapted("P", 0.9, 0.3)]
    unrelated = [msgspec.structs.replace(one, free_compliant=one.compliant) for one in adapted("B1-free", 0.5, 0.3)]
    alone, together = (evaluate_hypotheses(some)[2] for some in (rows, [*rows, *unrelated]))
    assert (alone.verdict, alone.claims[0].quantity) == ("supported", "one-shot compliance")
    assert together == alone


def test_equal_results_refute_only_after_many_runs():
    """Two equal runs leave the verdict undecided; forty equal runs refute."""
    few, many = (
        [
            one
            for name in ("M", "B4", "Full", "P", "PE")
            for run in range(runs)
            for one in (episode_row(name, run, seed=run, frequency=0.3, Delta=0.01),)
        ]
        for runs in (2, 40)
    )
    assert [one.verdict for one in evaluate_hypotheses(few)[1:]] == ["undecided"] * 2
    assert {claim.verdict for claim in evaluate_hypotheses(few)[2].claims} == {"undecided"}
    assert [one.verdict for one in evaluate_hypotheses(many)[1:]] == ["refuted"] * 2
    quiet = [msgspec.structs.replace(one, Delta=0.0, frequency=0.0) for one in many]
    results = evaluate_hypotheses(quiet)
    assert (results[1].verdict, results[1].claims[0].found.high) == ("undecided", np.inf)


def test_an_end_equal_to_the_minimum_up_to_rounding_is_on_neither_side():
    for end in (0.1, np.nextafter(0.1, 0.0), 0.3 - 0.2):
        assert claim_verdict(found(-0.01, end), 0.1, AT_LEAST) == "undecided"
        assert claim_verdict(found(end, 0.3), 0.1, AT_LEAST) == "supported"


def test_h3_is_also_evaluated_for_corrupted_prompts():
    rows = [*adapted("P-shortened", 0.2, 0.3), *adapted("PE-shortened", 0.98, 0.3)]
    compliance, frequency = secondary_claims(rows)
    assert (compliance.a, compliance.b, compliance.verdict) == ("P-shortened", "PE-shortened", "refuted")
    assert frequency.hypothesis == "H3"


def test_p_values_are_corrected_over_all_claims_together():
    rows = [*episodes("B1", 0.7), *episodes("B2", 0.6), *episodes("B3", 0.0)]
    claims = [claim for result in evaluate_hypotheses(rows) for claim in result.claims if claim.found.clusters]
    assert all(claim.p == pytest.approx(2 * claim.found.p) or claim.p >= claim.found.p for claim in claims)
    assert max(claim.p for claim in claims) < 0.05


def test_secondary_claims_follow_the_same_rule():
    """For the adversarial methods, other ε, and tool speed; methods that were not run have no claim."""
    rows = [
        *episodes("A1", 0.7),
        *episodes("A2", 0.6),
        *episodes("A3", 0.0),
        *repeated("M-half", 0.5),
        *repeated("B4", 1.0),
    ]
    claims = {(claim.a, claim.b, claim.quantity): claim for claim in secondary_claims(rows)}
    assert claims["A3", "A1", "violation rate"].verdict == claims["A3", "A2", "violation rate"].verdict == "supported"
    assert claims["M-half", "B4", "Δ of successes, later half"].verdict == "supported"
    assert len(claims) == 4
    assert all(result.verdict == "not measured" for result in evaluate_hypotheses(rows))
    fast = [msgspec.structs.replace(one, violations=(TOOL_SPEED,)) if one.method == "A3" else one for one in rows]
    rates = {claim.quantity: claim.verdict for claim in secondary_claims(fast) if (claim.a, claim.b) == ("A3", "A1")}
    assert rates == {"violation rate": "supported", "violation rate with tool speed": "refuted"}


def test_h2_is_also_evaluated_for_the_harder_level_alone():
    easy, hard = ([*repeated("M", factor), *repeated("B4", 1.0)] for factor in (1.0, 0.5))
    hard = [
        msgspec.structs.replace(one, level="II", pair=f"{one.pair} II", cluster=f"{one.cluster} II") for one in hard
    ]
    [claim] = secondary_claims([*easy, *hard])
    assert (claim.quantity, claim.verdict) == ("Δ of successes, later half, level II", "supported")
    assert claim.found.effect == pytest.approx(0.5, rel=0.05)


def test_paired_values_need_both_methods():
    rows = [episode_row("M", 0, seed=1), episode_row("M", 0, seed=2), episode_row("B4", 0, seed=2)]
    a, b = pair_values(rows, "M", "B4", METRIC_BY_NAME["success"].value_of)
    assert {name: len(values) for name, values in a.items()} == {name: len(values) for name, values in b.items()}
    assert sum(map(len, a.values())) == 1
