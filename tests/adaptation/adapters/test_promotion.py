"""The gate: better beyond chance somewhere, much worse nowhere, on the same questions in the same runtime."""

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


def trial_results(adapter, sound, n=60, *, success=None, Delta=0.002, perplexity=10.0, runtime="llama"):
    """`sound` of `n` questions are answered as they should be; all are carried out, `success` of them to the end."""
    done = n if success is None else success
    trials = tuple(
        QuestionResult(
            question=f"q{i}",
            compliant=i < sound,
            right=i < sound,
            success=i < done,
            Delta=Delta if i < done else 9.0 * (adapter == "new"),
        )
        for i in range(n)
    )
    return PlannerResults(adapter, runtime, perplexity, trials)


def verdict(new, old, tolerances=None, seed=0):
    return decide_promotion(new, old, tolerances or Tolerances(), np.random.default_rng(seed))


def test_what_is_clearly_better_is_promoted():
    found = verdict(trial_results("new", 58), trial_results("", 20))
    assert found.promotes
    assert found.measures["compliance"].gain == pytest.approx(38 / 60)
    assert found.measures["compliance"].low > 0.0
    assert msgspec.json.decode(msgspec.json.encode(found), type=PromotionDecision) == found


def test_a_decision_keeps_its_runtime_and_one_of_before_that_was_kept_is_read():
    found = verdict(trial_results("new", 58, runtime="llama 1"), trial_results("", 20, runtime="llama 1"))
    assert found.runtime == "llama 1"
    told = {name: value for name, value in msgspec.to_builtins(found).items() if name != "runtime"}
    assert msgspec.convert(told, PromotionDecision) == structs.replace(found, runtime="")


def test_the_same_is_not():
    found = verdict(trial_results("new", 40), trial_results("", 40))
    assert found.against == ("nothing is better beyond chance",)


@pytest.mark.parametrize(("ended", "promotes"), [(1, False), (9, False), (10, True)])
def test_few_deeds_that_both_brought_to_the_end_earn_no_promotion(ended, promotes):
    """The interval of one difference is a point."""
    new, old = trial_results("new", 40, success=ended, Delta=0.001), trial_results("", 40, success=ended, Delta=0.002)
    found = verdict(new, old, Tolerances(Delta=0.1))
    assert (found.measures["Delta"].low is not None) == promotes
    assert found.promotes == promotes


def test_one_question_more_is_chance():
    assert not verdict(trial_results("new", 41), trial_results("", 40)).promotes


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"success": 55}, "success fell"),
        ({"Delta": 0.0026}, "Delta fell"),
        ({"perplexity": 10.6}, "perplexity fell"),
    ],
)
def test_better_in_form_does_not_pay_for_worse_elsewhere(change, word):
    found = verdict(trial_results("new", 58, **change), trial_results("", 20))
    assert not found.promotes
    assert any(reason.startswith(word) for reason in found.against)
    assert verdict(
        trial_results("new", 58, **change), trial_results("", 20), Tolerances(success=0.1, Delta=0.001, perplexity=0.1)
    ).promotes


def test_a_fall_within_tolerance_is_borne():
    assert verdict(trial_results("new", 58, Delta=0.0024, perplexity=10.4), trial_results("", 20)).promotes


def test_delta_of_failures_does_not_count():
    """The candidate's failures have Δ = 9; only questions that both brought to the end are compared."""
    found = verdict(trial_results("new", 58, success=59), trial_results("", 20))
    assert found.measures["Delta"].gain == pytest.approx(0.0)


def test_less_intervention_alone_is_enough():
    new, old = trial_results("new", 40, Delta=0.001), trial_results("", 40, Delta=0.003)
    assert verdict(new, old).promotes
    assert not verdict(old, new).promotes


def on_the_ground(told, kept=0):
    """The same answers, carried out on the first `kept` questions only."""
    rows = (structs.replace(t, success=None, Delta=None) if i >= kept else t for i, t in enumerate(told.trials))
    return structs.replace(told, trials=tuple(rows))


@pytest.mark.parametrize("kept", [0, 59])
@pytest.mark.parametrize("who", [("candidate",), ("champion",), ("candidate", "champion")])
def test_who_was_not_flown_on_every_question_is_not_promoted_and_told_how(who, kept):
    both = {"candidate": trial_results("new", 58), "champion": trial_results("", 20)}
    assert verdict(*both.values()).promotes
    found = verdict(*(on_the_ground(told, kept) if name in who else told for name, told in both.items()))
    assert len(found.against) == len(who)
    for name, reason in zip(who, found.against, strict=True):
        assert f"the {name} was not flown on {60 - kept} of 60 questions" in reason
        assert "dualbrain adapters measure" in reason


@pytest.mark.parametrize("new", [0, 30])
def test_success_without_delta_is_no_reason_to_promote(new):
    """Whether nothing was brought to the end, or both brought some, but never the same question."""
    mine, theirs = trial_results("new", 58, success=new), trial_results("", 20, success=60)
    rows = tuple(structs.replace(t, success=i >= 30, Delta=0.002) for i, t in enumerate(theirs.trials))
    found = verdict(mine, structs.replace(theirs, trials=rows), Tolerances(success=1.0))
    assert "Delta" not in found.measures
    assert found.against == ("no Delta to compare: no question was brought to the end by both",)


def test_a_champion_that_brings_nothing_to_the_end_has_no_delta_to_defend():
    assert verdict(trial_results("new", 58, success=30), trial_results("", 0, success=0)).promotes
    assert not verdict(trial_results("new", 58, success=0), trial_results("", 0, success=0)).promotes


@given(st.integers(0, 40), st.integers(0, 40))
@settings(max_examples=40, deadline=None)
def test_never_both_ways(a, b):
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
def test_what_does_not_compare_is_refused(new, old):
    with pytest.raises(ConfigurationError):
        verdict(new, old)
