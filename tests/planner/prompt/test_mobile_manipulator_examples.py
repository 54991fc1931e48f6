"""The prompt for a mobile manipulator: its role, and the example that fits the instruction."""

import jsonschema_rs
import pytest

from dualbrain.contracts.scene_names import SceneNames
from dualbrain.contracts.schema import describe_skills, validation_schema
from dualbrain.grounding.offline_gate import scene_from_spec
from dualbrain.grounding.scene_summary import summarise_scene
from dualbrain.grounding.vocabulary import load_skill_registry, scene_names
from dualbrain.planner.prompt import mobile_manipulator_examples
from dualbrain.planner.prompt.full_prompt import MAX_EXEMPLARS, conditional_text_hash, render, template_hash
from dualbrain.planner.prompt.mobile_manipulator_examples import (
    DECLINE_EXAMPLE,
    DRIVE_EXAMPLE,
    DRIVE_THEN_FETCH_EXAMPLE,
    EXAMPLES,
    FETCH_EXAMPLE,
    FETCH_THEN_DRIVE_EXAMPLE,
    select_examples,
)
from dualbrain.records import RetrievedContext
from dualbrain.simulation.scenes.generators.catalogue import open_scene
from dualbrain.simulation.tasks.instructions import instruction_templates
from tests.planner.sample_requests import exemplar, plan_request

ROBOT = "mobile_panda"
SCENE = scene_from_spec(open_scene("workroom:0", ROBOT))
SUMMARY = summarise_scene(SCENE)
NAMES = {"object": "red_cube", "target": "blue_bowl"}


def request_for(words, **changed):
    skills = describe_skills(load_skill_registry(ROBOT), scene_names(SCENE))
    return plan_request(words, scene=SUMMARY, robot=ROBOT, skills_text=skills, **changed)


def skills_of(example):
    return [action["skill"] for action in example.actions]


def test_the_prompt_describes_base_and_arm():
    messages = render(request_for("go to the shelf"))
    assert messages[0]["content"].startswith('You plan for the mobile robot "mobile_panda"')
    assert len(messages) == 2 + 2 * MAX_EXEMPLARS
    assert "drive_to(" in messages[0]["content"]
    assert "grasp(" in messages[0]["content"]
    assert "bench: before table, heading 1.57" in messages[-1]["content"]


@pytest.mark.parametrize("one", instruction_templates("go"), ids=lambda one: one.text[:30])
def test_a_drive_is_the_last_example_for_an_instruction_to_go(one):
    assert select_examples(one.render(target="shelf"), SUMMARY, MAX_EXEMPLARS)[-1] is DRIVE_EXAMPLE


@pytest.mark.parametrize("one", instruction_templates("put_in"), ids=lambda one: one.text[:30])
def test_a_fetch_is_the_last_example_for_an_instruction_to_put(one):
    assert select_examples(one.render(**NAMES), SUMMARY, MAX_EXEMPLARS)[-1] is FETCH_EXAMPLE


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("go to the shelf, then put the red cube in the blue bowl", DRIVE_THEN_FETCH_EXAMPLE),
        ("put the red cube in the blue bowl and then drive to the charger", FETCH_THEN_DRIVE_EXAMPLE),
        ("put the cube in the bowl", FETCH_EXAMPLE),
    ],
)
def test_driving_and_fetching_are_shown_in_the_order_of_the_instruction(words, expected):
    shown = select_examples(words, SUMMARY, MAX_EXEMPLARS)
    assert shown[0] is DECLINE_EXAMPLE
    assert shown[-1] is expected


def test_retrieved_memories_replace_the_examples_that_fit_less():
    messages = render(
        request_for(
            "go to the shelf", recall=RetrievedContext(exemplars=(exemplar("best"), exemplar("second", rank=2)))
        )
    )
    assert len(messages) == 2 + 2 * MAX_EXEMPLARS
    assert DRIVE_EXAMPLE.instruction in messages[1]["content"]
    assert "best" in messages[-3]["content"]


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda example: example.instruction)
def test_the_examples_are_valid_contracts_and_follow_the_rules_of_the_prompt(example):
    registry = load_skill_registry(ROBOT)
    lines = dict(line.split(": ", 1) for line in example.scene.splitlines() if ": " in line)
    objects = [name for name, text in lines.items() if text.startswith("object")]
    spots = [name for name, text in lines.items() if text.startswith("container")] + lines["places"].split(", ")
    context = {"robot": ROBOT, "registry": registry.hash}
    contract = {"id": "c-0001", "context": context, "action_sequence": list(example.actions)}
    schema = validation_schema(registry, SceneNames(tuple(objects), tuple(spots)))
    jsonschema_rs.validator_for(schema).validate(contract)
    skills = skills_of(example)
    for before, action in zip([None, *example.actions], example.actions, strict=False):
        known = [parameter.name for parameter in registry.by_name[action["skill"]].parameters]
        assert list(action["params"]) == known, "the order of a constrained decoder"
        if action["skill"] == "turn_to":
            assert lines[before["params"]["place"]].endswith(f"heading {action['params']['heading']}")
        if action["skill"] == "grasp":
            assert before["skill"] == "turn_to", "the robot is at the object and faces it"
            assert "at counter" in lines[action["params"]["object"]]
        if action["skill"] == "drive_to" and before is not None:
            assert before["skill"] in ("home", "drive_to")
    assert skills.count("grasp") == skills.count("place")


def test_the_text_is_not_part_of_the_template_of_adapters(monkeypatch):
    before = conditional_text_hash(), template_hash()
    monkeypatch.setattr(mobile_manipulator_examples, "SYSTEM", "other words")
    assert conditional_text_hash() != before[0]
    assert template_hash() == before[1]
