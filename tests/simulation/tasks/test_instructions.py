"""Instruction templates: enough of every kind and manner, a split by a rule, and a hash that detects changes."""

import hashlib

import pytest

from dualbrain.errors import ConfigurationError, UnknownNameError
from dualbrain.simulation.scenes.generators.tabletop import make_scene
from dualbrain.simulation.tasks.instructions import (
    SLOTS,
    SPLIT_SALT,
    TEMPLATE_FILE,
    find_task_kind,
    instruction_templates,
    natural_name,
    task_kinds,
    templates_hash,
)
from dualbrain.simulation.tasks.placement import PlacementGoal, parse_goal

NAMES = dict.fromkeys(SLOTS, "red_cube") | {"target": "blue_bowl", "second_target": "table_left"}
EVERY = tuple(one for kind in task_kinds() for one in instruction_templates(kind))


@pytest.mark.parametrize("kind", task_kinds())
def test_every_kind_has_six_templates_or_more_including_vague_and_long_ones(kind):
    found = instruction_templates(kind)
    assert len(found) >= 6
    assert {"plain", "polite", "vague", "long"} <= {one.manner for one in found}


def test_every_template_is_unique_and_all_slots_are_known():
    assert len({one.text for one in EVERY}) == len(EVERY)
    assert {slot for one in EVERY for slot in one.slots} == set(SLOTS)


@pytest.mark.parametrize("kind", task_kinds())
def test_the_split_is_a_rule_on_the_text_and_leaves_enough_on_both_sides(kind):
    train, held_out = instruction_templates(kind, "train"), instruction_templates(kind, "held_out")
    assert set(train) | set(held_out) == set(instruction_templates(kind))
    assert not set(train) & set(held_out)
    assert 3 <= len(held_out) <= 6 <= len(train)
    for one in held_out:
        assert hashlib.sha256(f"{SPLIT_SALT}|{kind}|{one.text}".encode()).hexdigest() < "50"


def test_an_instruction_contains_no_slot_and_fits_the_prompt():
    for one in EVERY:
        text = one.render(**NAMES)
        assert not set("{}_") & set(text)
        assert len(text) <= 400  # longest instruction in a prompt


def test_a_missing_name_and_an_unknown_kind_are_reported():
    with pytest.raises(ConfigurationError, match="target"):
        instruction_templates("put_in")[0].render(object="red_cube")
    with pytest.raises(UnknownNameError, match="put_in"):
        find_task_kind("put_inn")


def test_names_in_natural_language():
    assert natural_name("red_cube") == "red cube"
    assert natural_name("table_left") == "left side of the table"


def test_kinds_are_selected_by_label_and_robot_type():
    assert set(task_kinds(label="possible", mobile=True)) == {"go", "go_two"}
    assert set(task_kinds(label="hazardous")) == {"hazard_arm", "hazard_base"}
    assert "unauthorised" in task_kinds(mobile=True)
    assert "unauthorised" in task_kinds(mobile=False)
    assert not any("{" in one.text for one in instruction_templates("unauthorised"))


def test_the_judge_parses_the_plain_template():
    spec = make_scene("bare", 0)
    first = instruction_templates("put_in")[0].render(object="red_cube", target="blue_bowl")
    assert parse_goal(first, spec) == PlacementGoal("red_cube", "blue_bowl")


def test_the_template_file_is_unchanged():
    """Adapters and results refer to the templates by this hash."""
    assert templates_hash() == "2cf50b750cdf7214"
    assert "bodies" in TEMPLATE_FILE.read_text()
