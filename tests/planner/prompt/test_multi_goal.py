"""Instructions with several goals: found by rule, told beside the unchanging prompt, each with a fitting example."""

import json

import pytest

from dualbrain.contracts.schema import describe_skills
from dualbrain.grounding.offline_gate import scene_from_spec
from dualbrain.grounding.vocabulary import load_skill_registry, scene_names
from dualbrain.planner.prompt.arm_examples import DECLINE_EXAMPLE
from dualbrain.planner.prompt.full_prompt import MAX_EXEMPLARS, conditional_text_hash, render
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
WANTED = {"put_two": {"order"}, "put_and_home": {"order"}, "put_all": {"every"}, "put_if_free": {"condition"}}


def asked(words, **changed):
    return plan_request(words, skills_text=SKILLS, **changed)


@pytest.mark.parametrize("kind", ["put_in", "put_at", "look", "push", "hold", "home", "cannot_arm", "hazard_arm"])
def test_one_goal_needs_nothing(kind):
    for one in instruction_templates(kind):
        assert detect_needs(asked(one.render(**NAMES))) == (), one.text


@pytest.mark.parametrize("kind", WANTED)
def test_several_goals_are_heard(kind):
    deaf = [
        one.text
        for one in instruction_templates(kind)
        if not WANTED[kind] <= set(detect_needs(asked(one.render(**NAMES))))
    ]
    assert deaf == []


def test_rules_and_examples_stand_beside_what_never_changes():
    plain = render(asked("put the red cube in the bowl"))
    told = render(asked("put all the red things in the blue bowl"))
    assert told[:3] == plain[:3]  # the system's words and the first example: what a server keeps
    assert DECLINE_EXAMPLE.instruction in told[1]["content"]
    assert len(told) == 2 + 2 * (1 + len(EXAMPLES["every"]))
    assert RULES["every"] in told[-1]["content"]
    assert RULES["order"] not in told[-1]["content"]
    assert told[-1]["content"].rindex("</instruction>") > told[-1]["content"].index(RULES["every"])
    assert EXAMPLES["every"][0].instruction in told[-3]["content"]


def test_memory_still_comes_last_and_leaves_room_for_one_example():
    recall = RetrievedContext(exemplars=(exemplar("best", rank=1), exemplar("second", rank=2)))
    told = render(asked("put all the red things in the blue bowl", recall=recall))
    assert len(told) == 2 + 2 * MAX_EXEMPLARS
    assert EXAMPLES["every"][0].instruction in told[1]["content"]
    assert "best" in told[-3]["content"]


def test_examples_obey_the_gate_and_their_own_words():
    registry = load_skill_registry("panda")
    for need, of in EXAMPLES.items():
        for example in of:
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
