"""Exploration: siblings in the twin, proposals of a value model, and the training set with rehearsal examples."""

import dataclasses
from types import SimpleNamespace

import msgspec
import numpy as np
import pytest

from dualbrain.adaptation.curation.curate import CurationConfig
from dualbrain.adaptation.value_model.value_model import fit_value_model
from dualbrain.contracts.verdict import Accepted
from dualbrain.core.paths import cache_folder
from dualbrain.errors import ConfigurationError
from dualbrain.grounding.alternatives import DEFAULT_ALTERNATIVE
from dualbrain.grounding.instruction.goals.goal import Goal
from dualbrain.grounding.instruction.goals.goal_reading import read_goal
from dualbrain.grounding.vocabulary import load_skill_registry
from dualbrain.runtime.data_collection.exploration import explore as exploration
from dualbrain.runtime.data_collection.exploration import held_out, rehearsal
from dualbrain.runtime.data_collection.exploration.corruption import FOREIGN_TEXTS, corrupt
from dualbrain.runtime.data_collection.exploration.explore import TRIALS_FILE, explore, nth_place, read_trials
from dualbrain.runtime.data_collection.exploration.held_out import make_scene_evaluator, without_values
from dualbrain.runtime.data_collection.exploration.place import Place
from dualbrain.runtime.data_collection.exploration.proposals import SOURCE, propose_best
from dualbrain.runtime.data_collection.exploration.rehearsal import draw_rehearsal
from dualbrain.runtime.data_collection.exploration.training_set import (
    TWIN_SOURCE,
    TrainingSetConfig,
    assemble_training_set,
    build_training_set,
    clean_from_trials,
)
from dualbrain.runtime.data_collection.exploration.trial import Trial, execute_siblings, group_siblings
from dualbrain.runtime.data_collection.exploration.twin_cell import make_twin_cell
from dualbrain.runtime.data_collection.rollouts import instruction_of
from dualbrain.runtime.data_collection.synthetic_scenes import scene_by_name, scene_context_by_name

BARE = Place("panda bare:50001", (("grasp", {"object": "red_cube"}), ("place", {"destination": "blue_bowl"})))
EPSILON = 0.0021


def trial(index, alternative, **outcome):
    """A trial at place `index` of the sequence 0 that was not executed."""
    place = nth_place("panda", "teach", 0, index)
    about = place.placement
    return Trial(
        scene=place.scene_name,
        object_name=about.object_name,
        destination=about.destination,
        summary=about.summary,
        alternative=alternative,
        contract=place.contracts()[alternative],
        world="twin",
        **({"kind": "succeeded", "Delta": 0.0, "duration": 10.0} | outcome),
    )


@pytest.fixture(scope="module")
def value_model():
    """A value model that prefers `slow` everywhere."""
    trials = [trial(i, name, Delta=0.0 if name == "slow" else 0.009) for i in range(4) for name in ("fitted", "slow")]
    return fit_value_model(group_siblings(trials), ridge=0.1)


def test_the_twin_executes_the_siblings_of_a_place():
    found = execute_siblings(BARE, [DEFAULT_ALTERNATIVE, "slow"])
    assert [one.kind for one in found] == ["succeeded", "succeeded"]
    assert found[0].duration < found[1].duration
    assert found[0].reason == "red_cube is at blue_bowl"
    assert {one.world for one in found} == {"twin"}


def test_the_twin_has_the_gate_of_the_robot():
    with make_twin_cell(BARE.spec) as cell:
        contract = msgspec.json.decode(BARE.contracts()[DEFAULT_ALTERNATIVE])
        assert isinstance(cell.check(contract), Accepted)
        contract["action_sequence"][0]["params"]["opening"] = 0.03
        assert not isinstance(cell.check(contract), Accepted)
        assert not cell.judgement().basis.judged


def test_the_twin_refuses_a_mobile_base():
    with pytest.raises(ConfigurationError, match="without a mobile base"):
        make_twin_cell(scene_by_name("base empty_room:50001"))


def test_an_interrupted_exploration_continues_with_the_same_trials(tmp_path, monkeypatch):
    def instant(place, names):
        return tuple(
            Trial(
                scene=place.scene_name,
                object_name=place.placement.object_name,
                destination=place.placement.destination,
                summary=place.summary,
                alternative=name,
                contract=place.contracts()[name],
                world="twin",
                kind="succeeded",
            )
            for name in names
        )

    monkeypatch.setattr(exploration, "execute_siblings", instant)
    whole = explore(tmp_path / "whole", 3)
    explore(tmp_path / "killed", 2)
    file = tmp_path / "killed" / TRIALS_FILE
    file.write_bytes(file.read_bytes()[:-40])  # killed while it wrote the second place
    assert {one.scene for one in read_trials(tmp_path / "killed")} == {whole[0].scene}
    assert explore(tmp_path / "killed", 3) == whole
    assert file.read_bytes() == (tmp_path / "whole" / TRIALS_FILE).read_bytes()
    assert len({one.alternative for one in whole}) > 8


def test_with_a_value_model_only_its_choice_is_executed(tmp_path, monkeypatch, value_model):
    executed = []
    monkeypatch.setattr(exploration, "execute_siblings", lambda place, names: executed.append(names) or ())
    explore(tmp_path, 2, seed=5, value_model=value_model)
    assert executed == [["slow"], ["slow"]]


def test_places_are_drawn_by_their_number():
    first, second = nth_place("panda", "teach", 7, 0), nth_place("panda", "teach", 7, 1)
    assert first.scene_name != second.scene_name
    assert nth_place("panda", "teach", 7, 1) == second
    assert nth_place("panda", "check", 7, 1).spec.seed in range(59_000, 60_000)


def test_a_proposal_is_the_choice_in_words_that_state_its_values(value_model):
    proposal = propose_best(value_model, 0, seed=3)
    place = nth_place("panda", "teach", 3, 0)
    assert proposal.contract == place.contracts()["slow"]
    assert proposal.source == SOURCE
    assert (
        f"opening {msgspec.json.decode(proposal.contract)['action_sequence'][0]['params']['opening']:g}"
        in (proposal.prompt[-1]["content"])
    )
    assert isinstance(read_goal(instruction_of(proposal), place.scene), Goal), "the senses can confirm the outcome"


def test_rehearsal_examples_are_accepted_by_the_gate_and_include_declines():
    examples = [draw_rehearsal("panda", "teach", 1, index) for index in range(20)]
    for one in examples:
        assert scene_context_by_name(one.scene).accepts(one.contract.encode())
    skills = {action["skill"] for one in examples for action in msgspec.json.decode(one.contract)["action_sequence"]}
    assert {"decline", "home"} <= skills
    assert draw_rehearsal("panda", "teach", 1, 4) == examples[4]


def test_a_rehearsal_example_that_the_gate_rejects_is_replaced(monkeypatch):
    first = draw_rehearsal("panda", "teach", 1, 0).contract.encode()
    make = rehearsal.make_scene_context

    def strict(spec):
        context = make(spec)
        return dataclasses.replace(context, accepts=lambda data: data != first and context.accepts(data))

    monkeypatch.setattr(rehearsal, "make_scene_context", strict)
    assert draw_rehearsal("panda", "teach", 1, 0).contract.encode() != first


def test_a_training_set_has_the_declared_composition(value_model):
    trials = [trial(index, "fitted") for index in range(6)]
    rejected = [trial(7, "fitted", Delta=0.01), trial(8, "fitted", kind="failed")]
    clean = clean_from_trials([*trials, *rejected], EPSILON, value_model)
    assert [one.scene for one in clean] == [one.scene for one in trials]
    samples = build_training_set(clean, "panda", TrainingSetConfig(wordings=4, rehearsal=0.25, exemplars=0.5))
    placements = [one for one in samples if one.source == TWIN_SOURCE]
    assert len(placements) == 24
    assert len(samples) == 32
    assert len({instruction_of(one) for one in placements if one.scene == trials[0].scene}) == 4
    with_exemplars = sum("<example>" in one.prompt[-1]["content"] for one in placements)
    assert 4 < with_exemplars < 20
    by_contract = {one.contract for one in placements}
    assert by_contract == {one.contract for one in trials}, "exemplars do not change the answer"


def test_corrupted_prompts_keep_their_answer_and_its_names(value_model):
    clean = clean_from_trials([trial(index, "fitted") for index in range(3)], EPSILON, value_model)
    config = TrainingSetConfig(wordings=6, rehearsal=0.0, exemplars=0.0, corrupted=1.0)
    complete = {one.place.summary for one in clean}
    samples = build_training_set(clean, "panda", config)
    assert {one.contract for one in samples} == {one.contract for one in clean}
    text = [one.prompt[-1]["content"] for one in samples]
    assert any(not any(scene in one for scene in complete) for one in text), "some scenes are incomplete"
    assert any(words in one for one in text for words in FOREIGN_TEXTS)
    for one in samples:
        grasp, _ = msgspec.json.decode(one.contract)["action_sequence"]
        assert grasp["params"]["object"] in one.prompt[-1]["content"]


@pytest.mark.parametrize("seed", range(20))
def test_a_cut_scene_keeps_the_lines_of_the_names(seed):
    scene = "robot panda; holding nothing\nred_cube: object, x\nblue_bowl: container\nperson: none\nplaces: table_left"
    found, sentence = corrupt(scene, "put it", ("red_cube", "blue_bowl"), np.random.default_rng(seed))
    assert {"red_cube", "blue_bowl"} <= {line.split(":")[0] for line in found.splitlines()}
    assert sentence.endswith("put it")


def test_the_weight_is_the_probability_to_beat_the_siblings(value_model):
    (good,) = clean_from_trials([trial(0, "slow")], EPSILON, value_model)
    (bad,) = clean_from_trials([trial(0, "fitted")], EPSILON, value_model)
    (unknown,) = clean_from_trials([trial(0, "tilted")], EPSILON, value_model)
    assert good.weight > 0.5 > bad.weight
    assert unknown.weight == 0.5


def test_the_card_of_a_training_set_states_its_prompts(value_model):
    samples = build_training_set(clean_from_trials([trial(0, "fitted")], EPSILON, value_model), "panda")
    dataset = assemble_training_set(samples[:-1], samples[-1:], load_skill_registry("panda"), CurationConfig())
    assert dataset.card.scene_values
    assert dataset.card.train == len(samples) - 1
    assert sum(dataset.card.sources.values()) == len(samples)


def test_perception_noise_is_that_of_the_full_simulation():
    with make_twin_cell(BARE.spec) as cell:
        seen = np.array(cell.executor.scene.find("red_cube").pose.position)
        true = np.array(cell.plant.true_pose("red_cube").position)
        assert 0.0 < np.linalg.norm(seen - true) <= cell.executor.scene.find("red_cube").error


def test_a_question_can_be_read_without_values(value_model):
    question = propose_best(value_model, 1, part="check", seed=3)
    plain = without_values(question)
    assert plain.id == question.id
    assert instruction_of(plain) == instruction_of(question)
    context = scene_context_by_name(question.scene)
    assert context.summary_with_values in question.prompt[-1]["content"]
    assert context.summary in plain.prompt[-1]["content"]


def test_both_planners_are_executed_with_the_same_seed_for_a_question(monkeypatch, tmp_path):
    """Also if one of them gave no compliant answer to an earlier question, which is then not executed."""
    seeds = []

    def run(one, ledger, turn, *, cache):
        seeds.append((one.id, turn))
        return SimpleNamespace(outcome=SimpleNamespace(kind="succeeded", Delta=0.0))

    monkeypatch.setattr(held_out, "run_proposal", run)
    questions = [draw_rehearsal("panda", "check", 0, index) for index in range(3)]
    execute = make_scene_evaluator(5, tmp_path)
    for question in (*questions, *questions[1:]):
        execute(question, question.contract)
    assert [turn for _, turn in seeds] == [5, 6, 7, 6, 7]


@pytest.mark.slow
def test_an_answer_is_executed_in_the_scene_of_its_question(value_model):
    execute = make_scene_evaluator(5, cache_folder())
    question = propose_best(value_model, 1, part="check", seed=3)
    success, Delta = execute(question, question.contract)
    assert success
    assert Delta is not None
    assert execute(question, question.contract.replace('"opening":0.0', '"opening":0.9')) == (False, None)
