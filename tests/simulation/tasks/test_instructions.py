"""Wordings: enough of every kind and manner, a split that nobody chooses, and a hash that says when they changed."""

import hashlib

import pytest

from dualbrain.errors import InvalidSetup, UnknownName
from dualbrain.simulation.scenes.generators.tabletop import make_scene
from dualbrain.simulation.tasks.instructions import FILE, SALT, SLOTS, kind_of, kinds, spoken, wordings, wordings_hash
from dualbrain.simulation.tasks.placement import Goal, goal_of

NAMES = dict.fromkeys(SLOTS, "red_cube") | {"target": "blue_bowl", "second_target": "table_left"}
EVERY = tuple(one for kind in kinds() for one in wordings(kind))


@pytest.mark.parametrize("kind", kinds())
def test_every_kind_has_six_wordings_and_more_vague_and_long_ones_too(kind):
    found = wordings(kind)
    assert len(found) >= 6
    assert {"plain", "polite", "vague", "long"} <= {one.manner for one in found}


def test_no_wording_stands_twice_and_all_slots_are_known():
    assert len({one.text for one in EVERY}) == len(EVERY)
    assert {slot for one in EVERY for slot in one.slots} == set(SLOTS)


@pytest.mark.parametrize("kind", kinds())
def test_the_split_is_a_rule_on_the_text_and_leaves_enough_on_both_sides(kind):
    train, held_out = wordings(kind, "train"), wordings(kind, "held_out")
    assert set(train) | set(held_out) == set(wordings(kind))
    assert not set(train) & set(held_out)
    assert 3 <= len(held_out) <= 6 <= len(train)
    for one in held_out:
        assert hashlib.sha256(f"{SALT}|{kind}|{one.text}".encode()).hexdigest() < "50"


def test_no_name_of_a_slot_is_left_in_the_words():
    for one in EVERY:
        words = one.words(**NAMES)
        assert not set("{}_") & set(words)
        assert len(words) <= 400  # what the prompt shows of an instruction


def test_a_missing_name_and_an_unknown_kind_are_told():
    with pytest.raises(InvalidSetup, match="target"):
        wordings("put_in")[0].words(object="red_cube")
    with pytest.raises(UnknownName, match="put_in"):
        kind_of("put_inn")


def test_places_are_spoken_as_people_call_them():
    assert spoken("red_cube") == "red cube"
    assert spoken("table_left") == "left side of the table"


def test_labels_and_bodies_narrow_the_kinds():
    assert set(kinds(label="possible", mobile=True)) == {"go", "go_two"}
    assert set(kinds(label="hazardous")) == {"hazard_arm", "hazard_base"}
    assert "unauthorised" in kinds(mobile=True)
    assert "unauthorised" in kinds(mobile=False)
    assert not any("{" in one.text for one in wordings("unauthorised"))


def test_plain_wordings_of_one_put_are_what_the_judge_reads():
    spec = make_scene("bare", 0)
    first = wordings("put_in")[0].words(object="red_cube", target="blue_bowl")
    assert goal_of(first, spec) == Goal("red_cube", "blue_bowl")


def test_the_file_is_the_one_that_was_fixed_beforehand():
    """A change shows here first: whatever was trained or measured on the old wordings names the old hash."""
    assert wordings_hash() == "2cf50b750cdf7214"
    assert "bodies" in FILE.read_text()
