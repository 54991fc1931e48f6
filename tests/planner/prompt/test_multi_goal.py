"""Instructions with several goals: detection by rules, separate prompt text, and a fitting example."""

import json

import pytest

from dualbrain.contracts.schema import describe_skills
from dualbrain.grounding.offline_gate import scene_from_spec
from dualbrain.grounding.vocabulary import load_skill_registry, scene_names
from dualbrain.planner.prompt.full_prompt import conditional_text_hash, render
from dualbrain.planner.prompt.multi_goal import EXAMPLES, RULES, detect_needs
from dualbrain.records import RetrievedContext
from dualbrain.simulation.scenes.generators.tabletop import make_scene
from dualbrain.simulation.tasks.instructions import instruction_templates
from tests.planner.sample_requests import exemplar, plan_request

SPEC = make_scene("sorting", 0)
SKILLS = describe_skills(load_skill_registry("panda"), scene_names(scene_from_spec(SPEC)))
NAMES = {
    "object": "red_cube",
    "target": "blue_bowl",
    "second": "yellow_block",
    "second_target": "table_left",
    "group": "red things",
}
NEEDS = {"put_two": {"order"}, "put_and_home": {"order"}, "put_all": {"every"}, "put_if_free": {"condition"}}


def request_for(words, **changed):
    return plan_request(words, skills_text=SKILLS, **changed)


@pytest.mark.parametrize("kind", ["put_in", "put_at", "look", "push", "hold", "home", "cannot_arm", "hazard_arm"])
def test_a_single_goal_has_no_needs(kind):
    for one in instruction_templates(kind):
        assert detect_needs(request_for(one.render(**NAMES))) == (), one.text


@pytest.mark.parametrize("kind", NEEDS)
def test_several_goals_are_detected(kind):
    missed = [
        one.text
        for one in instruction_templates(kind)
        if not NEEDS[kind] <= set(detect_needs(request_for(one.render(**NAMES))))
    ]
    assert missed == []


def test_rules_and_examples_do_not_change_the_constant_part():
    plain = render(request_for("put the red cube in the bowl"))
    messages = render(request_for("put all the red things in the blue bowl"))
    assert messages[: len(plain) - 1] == plain[:-1]  # a server has read this part before
    assert len(messages) == len(plain) + 2
    assert EXAMPLES["every"][0].instruction in messages[-3]["content"]
    assert RULES["every"] in messages[-1]["content"]
    assert RULES["order"] not in messages[-1]["content"]
    assert messages[-1]["content"].rindex("</instruction>") > messages[-1]["content"].index(RULES["every"])


def test_an_order_of_goals_has_its_example_in_the_constant_part():
    plain = render(request_for("put the red cube in the bowl"))
    messages = render(request_for("before you put the red cube in the bowl, bring the yellow block to the blue bowl"))
    assert messages[:-1] == plain[:-1]
    assert EXAMPLES["order"][0].instruction in str(messages[:-1])
    assert RULES["order"] in messages[-1]["content"]


def test_retrieved_memories_come_last():
    recall = RetrievedContext(exemplars=(exemplar("best", rank=1), exemplar("second", rank=2)))
    messages = render(request_for("put all the red things in the blue bowl", recall=recall))
    assert EXAMPLES["every"][0].instruction in messages[-7]["content"]
    assert "second" in messages[-5]["content"]
    assert "best" in messages[-3]["content"]


def test_examples_have_the_parameters_of_the_registry():
    registry = load_skill_registry("panda")
    for need, examples in EXAMPLES.items():
        for example in examples:
            skills = [action["skill"] for action in example.actions]
            assert skills == ["grasp", "place"] * (len(skills) // 2), need
            for action in example.actions:
                known = {parameter.name for parameter in registry.by_name[action["skill"]].parameters}
                assert action["params"].keys() == known
            assert json.dumps(example.actions)


def test_the_hash_covers_rules_and_examples(monkeypatch):
    before = conditional_text_hash()
    monkeypatch.setitem(RULES, "every", "other words")
    assert conditional_text_hash() != before
