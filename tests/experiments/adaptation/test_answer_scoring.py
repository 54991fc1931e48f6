"""The counting of the experiments on adaptation, with synthetic answers instead of a model."""

import json
from pathlib import Path

import pytest

from dualbrain.runtime.data_collection.synthetic_scenes import generate_examples
from experiments.adaptation import ablation_curve, retention, starter
from experiments.engine.experiment import Options
from experiments.planning import language


@pytest.fixture(scope="module")
def drawn():
    return generate_examples(40, "test", seed=3, robot_shares={"panda": 1.0}, exemplar_share=1.0)


def with_params(sample, **params):
    contract = json.loads(sample.contract)
    for step in contract["action_sequence"]:
        step["params"] |= {name: value for name, value in params.items() if name in step["params"]}
    return json.dumps(contract)


def test_the_correct_answer_counts_with_the_parameters_copied_from_the_exemplar(drawn):
    sample = next(
        one
        for one in drawn
        if '"place"' in one.contract and [a.skill for a in language.exemplar_actions(one)[0]][:1] == ["grasp"]
    )
    found = language.score_question(sample, sample.contract)
    assert language.is_right(found)
    first = language.exemplar_actions(sample)[0]
    grasp = next(action for action in first if action.skill == "grasp")
    free = {name: value for name, value in grasp.params.items() if name != "object"}
    same, every = language.copied_parameters(sample, with_params(sample, **free))
    assert every >= len(free)
    assert same >= len(free)
    few, every = language.copied_parameters(sample, with_params(sample, speed=0.123, clearance=0.123, force=12.3))
    assert few <= every - 3


@pytest.mark.slow
def test_a_request_is_in_one_slice():
    ids = [one.id for _, one in ablation_curve.questions()]
    assert len(ids) == len(set(ids)) == len(ablation_curve.SLICES) * ablation_curve.QUESTIONS_PER_SLICE


def test_an_invalid_answer_counts_for_nothing(drawn):
    for text in ("", "[]", "{", '{"id":1}'):
        found = language.score_question(drawn[0], text)
        assert not language.is_right(found)
        assert found["taken"] == (0, 0)


def test_tables_name_every_slice_and_arm(drawn):
    answers = [language.score_question(one, one.contract) for one in drawn]
    text = "\n".join(language.slice_table(answers))
    assert "| all | 40 of 40" in text
    assert "to be declined" in text
    answered = [{"slice": name, **one} for one in answers for name in ablation_curve.SLICES]
    common = {"steps": ablation_curve.N_STEPS, "valid_draws": 0.5, "answers": answered}
    rows = [
        {"arm": arm, "seed": seed, **common, "flights": [{"kind": "succeeded", "Delta": 0.001 * seed}]}
        for arm in ablation_curve.TRAINED_ARMS
        for seed in ablation_curve.SEEDS
    ]
    report = "\n".join(ablation_curve.AblationCurve().report(rows))
    for arm in ablation_curve.TRAINED_ARMS:
        assert f"| {arm} | {ablation_curve.N_STEPS} | 3 | 100% ± 0%" in report
    assert ablation_curve.format_mean_interval([0.0, 0.1, 0.2]) == "10% ± 25%"
    for limit in ("same 60 requests", "at most 18 episodes", "16 answers per arm and seed", "not those of llama.cpp"):
        assert limit in report
    assert "Student's t over 3 seeds" in ablation_curve.AblationCurve.intervals


def test_a_correct_answer_contains_one_of_the_words():
    assert retention.is_known("It has Eight legs.", "eight|8")
    assert not retention.is_known("It has many legs.", "eight|8")
    rows = [
        {"arm": arm, "perplexity": 9.5 + seed, "right": [True, False]}
        for arm in (retention.BASE_ADAPTER, *retention.CURVE_ARMS)
        for seed in range(1 if arm == retention.BASE_ADAPTER else 2)
    ]
    report = "\n".join(retention.Retention().report(rows))
    assert "| base-135m | 9.50 | 1 of 2" in report
    assert "| full | 9.50, 10.50 | 2 of 4" in report
    assert retention.BARE_MODEL not in report


def test_only_installed_planners_are_compared(monkeypatch):
    def planners():
        return {unit.parameters["who"] for unit in starter.Starter().units(Options(Path(), ""))}

    monkeypatch.setattr(starter, "packaged_names", lambda: ("base-135m",))
    assert planners() == {"base-135m", starter.LARGE_PLANNER}
    monkeypatch.setattr(starter, "packaged_names", lambda: ("base-135m", "starter-135m"))
    assert planners() == {"base-135m", "starter-135m", starter.LARGE_PLANNER}


def test_the_requests_of_the_comparison_are_for_a_table_and_have_no_exemplars():
    requests = starter.questions()
    assert len(requests) == starter.N_QUESTIONS
    assert all(one.scene.startswith("panda ") and not language.exemplar_actions(one) for one in requests)
