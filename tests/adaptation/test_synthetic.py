"""Lessons in the language of contracts: valid, random, of their own part, and nothing in them knows a body."""

import json
import re
from collections import Counter

import msgspec
import numpy as np
import pytest

from dualbrain.adaptation.synthetic import templates
from dualbrain.adaptation.synthetic.dataset import build_synthetic_dataset, make_language_judge
from dualbrain.adaptation.synthetic.example import FOLLOW_SHARE, free_parameters
from dualbrain.adaptation.synthetic.random_parameters import draw_number
from dualbrain.adaptation.synthetic.scoring import score_answer
from dualbrain.adaptation.synthetic.split import HELD_OUT_CATEGORIES, HELD_OUT_FAMILY, SCENE_SEEDS
from dualbrain.contracts.contract import Action, Contract
from dualbrain.contracts.skill_spec import ChoiceParameter, NumberParameter
from dualbrain.errors import ChecksumError
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
def taught():
    return generate_examples(250, "teach", seed=5)


@pytest.fixture(scope="module")
def tested():
    return generate_examples(60, "test", seed=5)


def question(sample):
    return sample.prompt[-1]["content"]


def words(sample):
    return re.search("<instruction>\n(.*)\n</instruction>", question(sample)).group(1)


def shown(sample):
    steps = re.findall("<example>\n(.*)\n</example>", question(sample))
    return [[msgspec.convert(step, Action) for step in json.loads(one)] for one in steps]


def contract(sample):
    return msgspec.json.decode(sample.contract, type=Contract)


def test_the_gate_of_the_scene_accepts_every_answer(taught, tested):
    for sample in (*taught[:80], *tested):
        assert scene_context_by_name(sample.scene).accepts(sample.contract.encode()), sample.contract


def test_the_same_arguments_give_the_same_lessons_and_no_question_twice(taught):
    again = generate_examples(30, "teach", seed=5)
    assert again == taught[:30]
    assert generate_examples(30, "teach", seed=6) != again
    assert len({question(sample) for sample in taught}) == len(taught)


def test_no_scene_or_thing_that_is_held_out_is_taught(taught, tested):
    for sample in taught:
        family, seed = re.search(r" (\w+):(\d+)$", sample.scene).groups()
        assert family != HELD_OUT_FAMILY
        assert int(seed) in SCENE_SEEDS["teach"]
        assert not [name for name in sample.graspable if name.rpartition("_")[2] in HELD_OUT_CATEGORIES]
    assert any(HELD_OUT_FAMILY in sample.scene for sample in tested)
    assert any("_carton" in name or "_bottle" in name for sample in tested for name in sample.graspable)


def pattern(sentence):
    return re.compile(re.sub(r"\\{\w+\\}", ".+", re.escape(sentence)) + r"\.?", re.IGNORECASE)


@pytest.mark.parametrize("drives", [False, True])
def test_a_sentence_is_taught_or_tested_never_both(taught, drives):
    mine, theirs = (load_phrasings(drives, part).sentences for part in ("teach", "test"))
    assert mine.keys() == theirs.keys()
    assert not {s for some in mine.values() for s in some} & {s for some in theirs.values() for s in some}
    said = [words(sample) for sample in taught if ("base" in sample.scene.split()[0]) == drives]
    for sentence in said:
        assert any(pattern(one).fullmatch(sentence) for some in mine.values() for one in some), sentence


def test_every_skill_a_sentence_can_ask_for_is_taught(taught):
    skills = Counter(action.skill for sample in taught for action in contract(sample).action_sequence)
    assert {"grasp", "place", "push", "move_to", "hold", "home", "drive_to", "turn_to", "decline"} <= skills.keys()


def test_parameters_are_spread_over_their_bounds(taught):
    """Nothing is preferred but what the gate lets through: each choice, and both halves of each range, often."""
    grasps = [a for sample in taught for a in contract(sample).action_sequence if a.skill == "grasp"]
    for spec in REGISTRIES["panda"].skill("grasp").parameters:
        values = [action.params[spec.name] for action in grasps]
        if isinstance(spec, ChoiceParameter):
            assert min(Counter(values)[choice] for choice in spec.choices) > 0.15 * len(values)
        elif isinstance(spec, NumberParameter) and spec.name != "opening":  # too narrow an opening is refused
            low = np.mean(np.array(values) < (spec.lower + spec.upper) / 2)
            assert 0.25 < low < 0.75, spec.name


def test_a_robot_that_drives_hears_of_its_places_in_either_order_and_alone():
    """Until 2026-11-23 two places were always the shelf and then the charger, and "go to the shelf" became both."""
    routes = Counter(
        tuple(action.params["place"] for action in contract(one).action_sequence if action.skill == "drive_to")
        for one in generate_examples(150, "teach", 5, {"base": 1.0}, exemplar_share=0.0)
    )
    there, back = routes["shelf", "charger"], routes["charger", "shelf"]
    assert min(there, back) > 10
    assert max(there, back) < 2 * min(there, back)
    assert routes["shelf",] + routes["charger",] > there + back


def test_an_exemplar_is_followed_as_often_as_declared(taught):
    followed = []
    for sample in taught:
        first = next(iter(shown(sample)), [])
        registry = REGISTRIES[sample.scene.split()[0]]
        for action in contract(sample).action_sequence:
            models = [one for one in first if one.skill == action.skill and action.skill not in ("hold", "turn_to")]
            if models and free_parameters(registry, action):
                followed.append(free_parameters(registry, action) in [free_parameters(registry, m) for m in models])
    assert len(followed) > 60
    assert abs(np.mean(followed) - FOLLOW_SHARE) < 0.15
    assert 0.3 < np.mean([bool(shown(sample)) for sample in taught]) < 0.7


def test_an_exemplar_reads_as_a_contract_does(taught):
    for sample in taught[:40]:
        steps = sample.contract.partition('"action_sequence":')[2][:-1]
        assert exemplar_steps(json.loads(sample.contract)) == (steps if len(steps) <= STEPS_LIMIT else "")


def test_a_refusal_answers_what_cannot_be_done(taught):
    for sample in taught:
        refuses = contract(sample).action_sequence[0].skill == "decline"
        if refuses and (missing := re.search("there is no ([a-z ]+) here", sample.contract)):
            assert missing.group(1) in words(sample).lower()
            assert missing.group(1).replace(" ", "_") not in (*sample.graspable, *sample.receptive)


def test_numbers_stay_within_their_bounds_and_are_short():
    rng = np.random.default_rng(1)
    for lower, upper in ((0.05, 0.4), (-3.1416, 3.1416), (10.0, 60.0), (0.02, 0.085), (0.3, 0.3), (0.0, 1000.0)):
        spec = NumberParameter(name="x", unit="m", lower=lower, upper=upper, lower_from="a", upper_from="b")
        drawn = [draw_number(spec, rng) for _ in range(300)]
        assert all(lower <= value <= upper and len(f"{value:g}") <= 6 for value in drawn)
        assert len(set(drawn)) > (5 if upper > lower else 0)


def test_another_file_of_lessons_is_refused(monkeypatch):
    monkeypatch.setattr(templates, "LESSONS_SHA256", "0" * 64)
    templates.load_templates.cache_clear()
    with pytest.raises(ChecksumError, match=r"lessons\.toml"):
        templates.load_templates()
    monkeypatch.undo()
    templates.load_templates.cache_clear()
    templates.load_templates()


def test_a_course_names_every_vocabulary_and_who_proposed(taught):
    made = build_synthetic_dataset(taught[:20], taught[20:24], REGISTRIES)
    assert (made.card.robot, made.card.registry) == ("panda", REGISTRIES["panda"].hash)
    assert made.card.also == {name: REGISTRIES[name].hash for name in ("ur5e", "base")}
    assert made.card.sources == {"templates": 24}
    assert (made.card.train, made.card.held_out) == (20, 4)


def changed(sample, **params):
    told = msgspec.to_builtins(contract(sample))
    told["action_sequence"][0]["params"] |= params
    return json.dumps(told)


def test_an_answer_is_scored_by_what_was_asked(taught):
    sample = next(s for s in taught if s.scene.startswith("panda") and '"place"' in s.contract and len(s.graspable) > 2)
    setting = scene_context_by_name(sample.scene)
    first = contract(sample).action_sequence[0].params
    other = next(name for name in sample.graspable if name != first["object"])

    def told(text):
        found = score_answer(text, sample.contract, setting.registry, setting.accepts)
        return found.json, found.compliant, found.skills, found.named, found.is_right

    decline = sample.contract.partition('"action_sequence"')[0]
    decline += '"action_sequence":[{"skill":"decline","params":{"reason":"no"}}]}'
    assert told(sample.contract) == (True, True, True, True, True)
    assert told(changed(sample, speed=0.123)) == (True, True, True, True, True)
    assert told(changed(sample, speed=99))[1:] == (False, True, True, False)
    assert told(changed(sample, object=other))[3] is False
    assert told(decline)[1:] == (False, False, False, False)
    assert told("[" * 100_000) == (False,) * 5
    assert told('{"id": 1}') == (True, False, False, False, False)
    judge = make_language_judge(REGISTRIES)
    assert judge(sample.contract, sample)
    assert not judge(decline, sample)
