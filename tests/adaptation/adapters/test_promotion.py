"""The promotion gate: significantly better in one measure, much worse in none, on the same questions and runtime."""

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec import structs

from dualbrain.adaptation.adapters.promotion import (
    MIN_SCENES,
    PlannerResults,
    PromotionDecision,
    QuestionResult,
    Tolerances,
    decide_promotion,
)
from dualbrain.adaptation.adapters.scene_statistics import scene_interval, sign_flip_p
from dualbrain.errors import ConfigurationError
from dualbrain.evaluation.analysis import statistics


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


def in_scenes(results, count):
    """The same results, as equally many questions in each of `count` scenes, one scene after the other."""
    n = len(results.trials)
    rows = (structs.replace(trial, scene=f"s{i * count // n}") for i, trial in enumerate(results.trials))
    return structs.replace(results, trials=tuple(rows))


def drawn_results(rng, adapter, n_scenes, n_questions):
    """Results of a planner of constant quality: all questions of a scene have the result of the scene."""
    right, ends, Delta = (rng.random(n_scenes) for _ in range(3))
    trials = tuple(
        QuestionResult(
            question=f"q{scene} {number}",
            scene=f"s{scene}",
            compliant=bool(right[scene] < 0.8),
            right=bool(right[scene] < 0.7),
            success=bool(right[scene] < 0.7 and ends[scene] < 0.9),
            Delta=0.002 * float(Delta[scene]),
        )
        for scene in range(n_scenes)
        for number in range(n_questions)
    )
    return PlannerResults(adapter, "llama", 10.0, trials)


@pytest.mark.parametrize(("n_scenes", "n_questions"), [(4, 10), (12, 4), (40, 1)])
def test_an_equal_planner_is_rarely_promoted(n_scenes, n_questions):
    """The four measures are tested together at 5 %, two-sided: an equal planner is better by chance in 2.5 %."""
    rng = np.random.default_rng([1, n_scenes])
    found = [
        verdict(*(drawn_results(rng, name, n_scenes, n_questions) for name in ("new", "")), seed=seed)
        for seed in range(100)
    ]
    assert sum(any(measure.is_better for measure in one.measures.values()) for one in found) <= 5
    assert sum(one.promotes for one in found) <= 5


def test_questions_of_the_same_scenes_are_no_further_evidence():
    """Fifteen more right answers: enough in scenes of their own, not in three scenes of twelve."""
    new, old = trial_results("new", 45), trial_results("", 30)
    assert verdict(new, old).promotes
    found = verdict(in_scenes(new, 12), in_scenes(old, 12))
    assert found.against == ("no measure is significantly better",)
    assert verdict(in_scenes(trial_results("new", 58), 12), in_scenes(trial_results("", 0), 12)).promotes


@pytest.mark.parametrize("count", [1, MIN_SCENES - 1])
def test_questions_of_few_scenes_justify_no_promotion(count):
    found = verdict(in_scenes(trial_results("new", 60), count), in_scenes(trial_results("", 0, success=0), count))
    assert {measure.p for measure in found.measures.values()} == {None}
    words = "1 scene," if count == 1 else f"{count} scenes,"
    assert found.against[0] == f"the questions are of {words} at least 10 are needed"


def test_an_improvement_is_corrected_over_the_measures():
    """Seven of seven different scenes have p = 0.016, and 0.06 after correction; eight have 0.03."""
    for better, promotes in ((7, False), (8, True)):
        found = verdict(trial_results("new", 20 + better, n=30, success=10), trial_results("", 20, n=30, success=10))
        compliance = found.measures["compliance"]
        assert compliance.low > 0.0
        assert compliance.p == pytest.approx(4 * 2 * 0.5**better, rel=0.3)
        assert (compliance.is_better, found.promotes) == (promotes, promotes)


def test_measurements_without_scenes_are_read_and_each_question_is_a_scene():
    new, old = trial_results("new", 58), trial_results("", 20)
    stored = msgspec.to_builtins(new)
    for trial in stored["trials"]:
        del trial["scene"]
    assert msgspec.convert(stored, PlannerResults) == new
    assert verdict(new, old) == verdict(in_scenes(new, 60), in_scenes(old, 60))


@pytest.mark.parametrize("n_scenes", [10, 30])
def test_the_statistics_of_scenes_are_those_of_the_evaluation(n_scenes):
    scenes = np.random.default_rng(n_scenes).normal(0.2, 1.0, size=(n_scenes, 3))
    mine = scene_interval(list(scenes), np.random.default_rng(0))
    theirs = statistics.estimate({str(i): list(one) for i, one in enumerate(scenes)})
    assert mine == pytest.approx((theirs.low, theirs.high), abs=0.06)
    p = statistics.sign_flip_p(scenes.mean(axis=1))
    assert sign_flip_p(list(scenes), np.random.default_rng(0)) == pytest.approx(p, abs=0.02 * (n_scenes > 16) + 1e-12)


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
        (in_scenes(trial_results("new", 10), 30), in_scenes(trial_results("", 5), 20)),
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
