"""Synthetic examples: valid, random, of their own part of the split, and without knowledge of any robot."""

import json
import re
from collections import Counter

import msgspec
import numpy as np
import pytest

from dualbrain.adaptation.synthetic import templates
from dualbrain.adaptation.synthetic.dataset import build_synthetic_dataset, make_language_judge
from dualbrain.adaptation.synthetic.example import FOLLOW_SHARE, free_parameters
from dualbrain.adaptation.synthetic.instruction import split_clause
from dualbrain.adaptation.synthetic.random_parameters import draw_number
from dualbrain.adaptation.synthetic.scoring import score_answer
from dualbrain.adaptation.synthetic.split import HELD_OUT_CATEGORIES, HELD_OUT_FAMILY, SCENE_SEEDS
from dualbrain.contracts.contract import Action, Contract
from dualbrain.contracts.skill_spec import ChoiceParameter, NumberParameter
from dualbrain.errors import ChecksumError
from dualbrain.grounding.instruction.clauses.clause_search import Clause, find_clauses
from dualbrain.grounding.instruction.clauses.expressible import capabilities
from dualbrain.grounding.instruction.review import brief_reason
from dualbrain.grounding.instruction.words import normalise
from dualbrain.grounding.vocabulary import load_skill_registry
from dualbrain.planner.prompt.short_prompt import STEPS_LIMIT, exemplar_steps
from dualbrain.runtime.data_collection.synthetic_scenes import (
    ROBOT_SHARES,
    generate_examples,
    load_phrasings,
    scene_context_by_name,
)

REGISTRIES = {robot: load_skill_registry(robot) for robot in ROBOT_SHARES}


@pytest.fixture(scope="module")
def train():
    return generate_examples(250, "teach", seed=5)


@pytest.fixture(scope="module")
def test_part():
    return generate_examples(60, "test", seed=5)


def question_text(sample):
    return sample.prompt[-1]["content"]


def instruction_text(sample):
    return re.search("<instruction>\n(.*)\n</instruction>", question_text(sample)).group(1)


def shown_exemplars(sample):
    steps = re.findall("<example>\n(.*)\n</example>", question_text(sample))
    return [[msgspec.convert(step, Action) for step in json.loads(one)] for one in steps]


def contract(sample):
    return msgspec.json.decode(sample.contract, type=Contract)


@pytest.mark.parametrize(
    ("of_train", "of_test"),
    [(slice(40), slice(20)), pytest.param(slice(40, 80), slice(20, None), marks=pytest.mark.slow)],
)
def test_the_gate_of_the_scene_accepts_every_answer(train, test_part, of_train, of_test):
    for sample in (*train[of_train], *test_part[of_test]):
        assert scene_context_by_name(sample.scene).accepts(sample.contract.encode()), sample.contract


def test_equal_arguments_give_equal_examples_and_no_question_occurs_twice(train):
    again = generate_examples(30, "teach", seed=5)
    assert again == train[:30]
    assert generate_examples(30, "teach", seed=6) != again
    assert len({question_text(sample) for sample in train}) == len(train)


def test_the_training_part_contains_no_held_out_scene_or_object(train, test_part):
    for sample in train:
        family, seed = re.search(r" (\w+):(\d+)$", sample.scene).groups()
        assert family != HELD_OUT_FAMILY
        assert int(seed) in SCENE_SEEDS["teach"]
        assert not [name for name in sample.graspable if name.rpartition("_")[2] in HELD_OUT_CATEGORIES]
    assert any(HELD_OUT_FAMILY in sample.scene for sample in test_part)
    assert any("_carton" in name or "_bottle" in name for sample in test_part for name in sample.graspable)


def pattern(sentence):
    sentence = re.sub(r"\[\[[^:]*: (.*?)\]\]", r"\1", sentence)
    return re.compile(re.sub(r"\\{\w+\\}", ".+", re.escape(sentence)) + r"\.?", re.IGNORECASE)


@pytest.mark.parametrize("drives", [False, True])
def test_no_sentence_is_in_both_the_training_and_the_test_part(train, drives):
    train_sentences, test_sentences = (load_phrasings(drives, part).sentences for part in ("teach", "test"))
    assert train_sentences.keys() == test_sentences.keys()
    assert not {s for some in train_sentences.values() for s in some} & {
        s for some in test_sentences.values() for s in some
    }
    instructions = [instruction_text(sample) for sample in train if ("base" in sample.scene.split()[0]) == drives]
    for sentence in instructions:
        assert any(pattern(one).fullmatch(sentence) for some in train_sentences.values() for one in some), sentence


def test_every_skill_that_a_sentence_can_request_occurs(train):
    skills = Counter(action.skill for sample in train for action in contract(sample).action_sequence)
    assert {"grasp", "place", "push", "move_to", "hold", "home", "drive_to", "turn_to", "decline"} <= skills.keys()


def test_parameters_are_spread_over_their_bounds(train):
    """No value is preferred except by the gate: each choice, and both halves of each range, occur often."""
    grasps = [a for sample in train for a in contract(sample).action_sequence if a.skill == "grasp"]
    for spec in REGISTRIES["panda"].skill("grasp").parameters:
        values = [action.params[spec.name] for action in grasps]
        if isinstance(spec, ChoiceParameter):
            assert min(Counter(values)[choice] for choice in spec.choices) > 0.15 * len(values)
        elif isinstance(spec, NumberParameter) and spec.name != "opening":  # too narrow an opening is refused
            low = np.mean(np.array(values) < (spec.lower + spec.upper) / 2)
            assert 0.25 < low < 0.75, spec.name


def test_a_mobile_robot_visits_its_places_in_either_order_and_alone():
    """Regression: two places were always the shelf and then the charger, and "go to the shelf" became both."""
    routes = Counter(
        tuple(action.params["place"] for action in contract(one).action_sequence if action.skill == "drive_to")
        for one in generate_examples(150, "teach", 5, {"base": 1.0}, exemplar_share=0.0)
    )
    shelf_first, charger_first = routes["shelf", "charger"], routes["charger", "shelf"]
    assert min(shelf_first, charger_first) > 10
    assert max(shelf_first, charger_first) < 2 * min(shelf_first, charger_first)
    assert routes["shelf",] + routes["charger",] > shelf_first + charger_first


def test_answers_copy_from_the_first_exemplar_as_often_as_declared(train):
    followed = []
    for sample in train:
        first = next(iter(shown_exemplars(sample)), [])
        registry = REGISTRIES[sample.scene.split()[0]]
        for action in contract(sample).action_sequence:
            models = [one for one in first if one.skill == action.skill and action.skill not in ("hold", "turn_to")]
            if models and free_parameters(registry, action):
                followed.append(free_parameters(registry, action) in [free_parameters(registry, m) for m in models])
    assert len(followed) > 60
    assert abs(np.mean(followed) - FOLLOW_SHARE) < 0.15
    assert 0.3 < np.mean([bool(shown_exemplars(sample)) for sample in train]) < 0.7


def test_an_exemplar_has_the_text_of_a_contract(train):
    for sample in train[:40]:
        steps = sample.contract.partition('"action_sequence":')[2][:-1]
        assert exemplar_steps(json.loads(sample.contract)) == (steps if len(steps) <= STEPS_LIMIT else "")


def test_a_decline_names_a_missing_object_of_the_instruction(train):
    for sample in train:
        declines = contract(sample).action_sequence[0].skill == "decline"
        if declines and (missing := re.search("there is no ([a-z ]+) here", sample.contract)):
            assert missing.group(1) in instruction_text(sample).lower()
            assert missing.group(1).replace(" ", "_") not in (*sample.graspable, *sample.receptive)


def test_drawn_numbers_are_within_their_bounds_and_have_few_digits():
    rng = np.random.default_rng(1)
    for lower, upper in ((0.05, 0.4), (-3.1416, 3.1416), (10.0, 60.0), (0.02, 0.085), (0.3, 0.3), (0.0, 1000.0)):
        spec = NumberParameter(name="x", unit="m", lower=lower, upper=upper, lower_from="a", upper_from="b")
        drawn = [draw_number(spec, rng) for _ in range(300)]
        assert all(lower <= value <= upper and len(f"{value:g}") <= 6 for value in drawn)
        assert len(set(drawn)) > (5 if upper > lower else 0)


def test_another_template_file_is_rejected(monkeypatch):
    monkeypatch.setattr(templates, "TEMPLATE_FILE_SHA256", "0" * 64)
    templates.load_templates.cache_clear()
    with pytest.raises(ChecksumError, match=r"templates\.toml"):
        templates.load_templates()
    monkeypatch.undo()
    templates.load_templates.cache_clear()
    templates.load_templates()


def test_a_synthetic_data_set_names_every_vocabulary_and_its_source(train):
    made = build_synthetic_dataset(train[:20], train[20:24], REGISTRIES)
    assert (made.card.robot, made.card.registry) == ("panda", REGISTRIES["panda"].hash)
    assert made.card.also == {name: REGISTRIES[name].hash for name in ("ur5e", "base")}
    assert made.card.sources == {"templates": 24}
    assert (made.card.train, made.card.held_out) == (20, 4)


def with_parameters(sample, **params):
    fields = msgspec.to_builtins(contract(sample))
    fields["action_sequence"][0]["params"] |= params
    return json.dumps(fields)


def test_an_answer_is_scored_against_the_instruction(train):
    sample = next(s for s in train if s.scene.startswith("panda") and '"place"' in s.contract and len(s.graspable) > 2)
    context = scene_context_by_name(sample.scene)
    first = contract(sample).action_sequence[0].params
    other = next(name for name in sample.graspable if name != first["object"])

    def scores(text):
        found = score_answer(text, sample.contract, context.registry, context.accepts)
        return found.json, found.compliant, found.skills, found.named, found.is_right

    decline = sample.contract.partition('"action_sequence"')[0]
    decline += '"action_sequence":[{"skill":"decline","params":{"reason":"no"}}]}'
    assert scores(sample.contract) == (True, True, True, True, True)
    assert scores(with_parameters(sample, speed=0.123)) == (True, True, True, True, True)
    assert scores(with_parameters(sample, speed=99))[1:] == (False, True, True, False)
    assert scores(with_parameters(sample, object=other))[3] is False
    assert scores(decline)[1:] == (False, False, False, False)
    assert scores("[" * 100_000) == (False,) * 5
    assert scores('{"id": 1}') == (True, False, False, False, False)
    judge = make_language_judge(REGISTRIES)
    assert judge(sample.contract, sample)
    assert not judge(decline, sample)


CLAUSE_KINDS = {"clause_arm": "panda", "clause_base": "base"}


def clause_sentences():
    """Every sentence with a clause: the robot, the clause's kind and words, and the sentence without the mark."""
    slots = dict.fromkeys(("object", "second"), "red cube") | {"group": "red things", "number": "5"}
    for name, robot in CLAUSE_KINDS.items():
        places = {"target": "blue bowl", "second_target": "front of the table"}
        if robot == "base":
            places = {"target": "shelf", "second_target": "charger"}
        kind = templates.load_templates().kinds[name]
        for marked in (*kind.train_sentences, *kind.held_out):
            before, clause, words, after = split_clause(marked.format(**slots, **places))
            yield robot, clause, words, before + words + after


@pytest.mark.parametrize(("robot", "clause", "words", "sentence"), tuple(clause_sentences()))
def test_the_local_check_declines_every_clause_that_the_examples_decline(robot, clause, words, sentence):
    """What a planner learns to quote is the clause that the local check names, or a part of it."""
    found = find_clauses(normalise(sentence), capabilities(REGISTRIES[robot]), ("blue_bowl", "table_front", "shelf"))
    assert clause in [one.kind for one in found]
    assert any(one.quote in words or words in one.quote for one in found)


def test_a_decline_of_a_clause_quotes_the_instruction_in_the_words_of_the_local_check():
    shares = {"panda": 0.5, "base": 0.5}
    samples = [one for one in generate_examples(400, "teach", 6, shares) if "no contract can express" in one.contract]
    assert len(samples) > 15
    for sample in samples:
        (action,) = contract(sample).action_sequence
        quote, kind = re.fullmatch(r'no contract can express "(.+)" \((.+)\)', action.params["reason"]).groups()
        assert quote in instruction_text(sample)
        assert action.params["reason"] == brief_reason(Clause(kind, quote))
        assert scene_context_by_name(sample.scene).accepts(sample.contract.encode())
