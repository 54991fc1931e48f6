"""The promotion gate: significantly better in one measure, much worse in none, on the same questions and runtime."""

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec import structs

from dualbrain.adaptation.adapters.promotion import (
    PlannerResults,
    PromotionDecision,
    QuestionResult,
    Tolerances,
    decide_promotion,
)
from dualbrain.errors import ConfigurationError


def trial_results(adapter, n_right, n=60, *, success=None, Delta=0.002, perplexity=10.0, runtime="llama"):
    """Results with `n_right` of `n` answers right; all contracts are executed, `success` of them successfully."""
    done = n if success is None else success
    trials = tuple(
        QuestionResult(
            question=f"q{i}",
            compliant=i < n_right,
            right=i < n_right,
            success=i < done,
            Delta=Delta if i < done else 9.0 * (adapter == "new"),
        )
        for i in range(n)
    )
    return PlannerResults(adapter, runtime, perplexity, trials)


def verdict(candidate, champion, tolerances=None, seed=0):
    return decide_promotion(candidate, champion, tolerances or Tolerances(), np.random.default_rng(seed))


def test_a_clearly_better_candidate_is_promoted():
    found = verdict(trial_results("new", 58), trial_results("", 20))
    assert found.promotes
    assert found.measures["compliance"].gain == pytest.approx(38 / 60)
    assert found.measures["compliance"].low > 0.0
    assert msgspec.json.decode(msgspec.json.encode(found), type=PromotionDecision) == found


def test_a_decision_records_its_runtime_and_older_decisions_without_one_are_read():
    found = verdict(trial_results("new", 58, runtime="llama 1"), trial_results("", 20, runtime="llama 1"))
    assert found.runtime == "llama 1"
    stored = {name: value for name, value in msgspec.to_builtins(found).items() if name != "runtime"}
    assert msgspec.convert(stored, PromotionDecision) == structs.replace(found, runtime="")


def test_an_equal_candidate_is_not_promoted():
    found = verdict(trial_results("new", 40), trial_results("", 40))
    assert found.against == ("no measure is significantly better",)


@pytest.mark.parametrize(("ended", "promotes"), [(1, False), (9, False), (10, True)])
def test_few_executions_that_succeeded_for_both_justify_no_promotion(ended, promotes):
    """The bootstrap interval of a single difference is a point."""
    new, old = trial_results("new", 40, success=ended, Delta=0.001), trial_results("", 40, success=ended, Delta=0.002)
    found = verdict(new, old, Tolerances(Delta=0.1))
    assert (found.measures["Delta"].low is not None) == promotes
    assert found.promotes == promotes


def test_one_more_right_answer_is_not_significant():
    assert not verdict(trial_results("new", 41), trial_results("", 40)).promotes


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"success": 55}, "success got worse"),
        ({"Delta": 0.0026}, "Delta got worse"),
        ({"perplexity": 10.6}, "perplexity got worse"),
    ],
)
def test_better_form_does_not_compensate_a_worse_measure(change, word):
    found = verdict(trial_results("new", 58, **change), trial_results("", 20))
    assert not found.promotes
    assert any(reason.startswith(word) for reason in found.against)
    assert verdict(
        trial_results("new", 58, **change), trial_results("", 20), Tolerances(success=0.1, Delta=0.001, perplexity=0.1)
    ).promotes


def test_a_loss_within_its_tolerance_is_accepted():
    assert verdict(trial_results("new", 58, Delta=0.0024, perplexity=10.4), trial_results("", 20)).promotes


def test_delta_of_failures_does_not_count():
    """The candidate's failures have Δ = 9; only questions on which both succeeded are compared."""
    found = verdict(trial_results("new", 58, success=59), trial_results("", 20))
    assert found.measures["Delta"].gain == pytest.approx(0.0)


def test_less_intervention_alone_justifies_a_promotion():
    new, old = trial_results("new", 40, Delta=0.001), trial_results("", 40, Delta=0.003)
    assert verdict(new, old).promotes
    assert not verdict(old, new).promotes


def partly_executed(results, kept=0):
    """The same answers, executed on the first `kept` questions only."""
    rows = (structs.replace(t, success=None, Delta=None) if i >= kept else t for i, t in enumerate(results.trials))
    return structs.replace(results, trials=tuple(rows))


@pytest.mark.parametrize("kept", [0, 59])
@pytest.mark.parametrize("who", [("candidate",), ("champion",), ("candidate", "champion")])
def test_a_planner_that_was_not_executed_on_every_question_prevents_the_promotion(who, kept):
    both = {"candidate": trial_results("new", 58), "champion": trial_results("", 20)}
    assert verdict(*both.values()).promotes
    found = verdict(*(partly_executed(results, kept) if name in who else results for name, results in both.items()))
    assert len(found.against) == len(who)
    for name, reason in zip(who, found.against, strict=True):
        assert f"the {name} was not executed on {60 - kept} of 60 questions" in reason
        assert "dualbrain adapters measure" in reason


@pytest.mark.parametrize("new", [0, 30])
def test_success_without_a_comparable_delta_does_not_justify_a_promotion(new):
    """Neither if the candidate never succeeds, nor if both succeed, but never on the same question."""
    mine, theirs = trial_results("new", 58, success=new), trial_results("", 20, success=60)
    rows = tuple(structs.replace(t, success=i >= 30, Delta=0.002) for i, t in enumerate(theirs.trials))
    found = verdict(mine, structs.replace(theirs, trials=rows), Tolerances(success=1.0))
    assert "Delta" not in found.measures
    assert found.against == ("Delta cannot be compared: no question was executed with success by both",)


def test_a_champion_without_success_needs_no_comparison_of_delta():
    assert verdict(trial_results("new", 58, success=30), trial_results("", 0, success=0)).promotes
    assert not verdict(trial_results("new", 58, success=0), trial_results("", 0, success=0)).promotes


@given(st.integers(0, 40), st.integers(0, 40))
@settings(max_examples=40, deadline=None)
def test_at_most_one_of_two_planners_is_better(a, b):
    one, other = trial_results("one", a, n=40), trial_results("other", b, n=40)
    assert not (verdict(one, other).promotes and verdict(other, one).promotes)


@pytest.mark.parametrize(
    ("new", "old"),
    [
        (trial_results("new", 10, n=29), trial_results("", 5, n=29)),
        (trial_results("new", 10, n=31), trial_results("", 5, n=30)),
        (trial_results("new", 10, runtime="torch"), trial_results("", 5)),
        (trial_results("", 10), trial_results("", 5)),
        (trial_results("new", 10, perplexity=float("nan")), trial_results("", 5)),
        (trial_results("new", 10, perplexity=0.9), trial_results("", 5)),
        (trial_results("new", 58, Delta=-7.0), trial_results("", 20)),
        (trial_results("new", 58), trial_results("", 20, Delta=float("inf"))),
        (trial_results("new", 58, Delta=float("nan")), trial_results("", 20)),
        (
            msgspec.structs.replace(trial_results("new", 10), trials=trial_results("new", 10).trials[:-1] * 2),
            trial_results("", 5),
        ),
    ],
)
def test_results_that_cannot_be_compared_are_rejected(new, old):
    with pytest.raises(ConfigurationError):
        verdict(new, old)
