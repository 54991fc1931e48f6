"""The scene, the skills and the other words of an instruction decide whether words are a clause."""

import pytest

from dualbrain.grounding.instruction.clauses.clause_search import find_clauses
from dualbrain.grounding.instruction.clauses.masks.parameter_values import mask_parameter_values
from dualbrain.grounding.instruction.words import normalise, sentences
from tests.grounding.instruction.test_clauses import ABILITIES

PLACES = ("blue_bowl", "table_left", "table_right", "table_front")
OBJECTS = ("red_cube", "red_tin", "green_tin", "clear_glass")


def kinds(text, graspable=OBJECTS, receptive=PLACES, robot="panda"):
    return [clause.kind for clause in find_clauses(normalise(text), ABILITIES[robot], receptive, graspable)]


def test_the_point_of_a_decimal_number_ends_no_sentence():
    text = normalise("Move at 0.1 m/s. Then stop.").text
    assert [text[start:end].strip() for start, end in sentences(text)] == ["move at 0.1 m / s .", "then stop ."]


@pytest.mark.parametrize(
    "value",
    ["at no more than 0.1 m/s", "with at most 5 N", "at a speed of 10 cm/s", "with a force of 8 newtons"],
)
def test_a_number_that_a_skill_takes_is_no_clause(value):
    assert kinds(f"put the red cube in the bowl {value}") == []
    assert value.split()[-1] not in mask_parameter_values(normalise(f"grasp the cube {value}").text, ABILITIES["panda"])


def test_a_robot_without_the_parameter_does_not_take_the_number():
    text = normalise("drive to the shelf with at most 5 N").text
    assert mask_parameter_values(text, ABILITIES["base"]) == text


def test_a_carrying_height_is_no_place():
    assert kinds("stay 20 cm above the table and put the red cube in the bowl") == []
    assert kinds("place the red cube 20 cm above the bowl") == ["relative place"]


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("if the bowl is empty, put the red cube in it", []),
        ("put the red cube in the bowl if it is empty", []),
        ("put the glass on the left if it is empty", ["condition"]),
        ("put the red cube in the bowl unless it turns out to be full", ["condition"]),
    ],
)
def test_only_a_visible_state_of_a_container_is_no_condition(text, found):
    assert kinds(text) == found


@pytest.mark.parametrize("polite", ["if you can", "when you have a second", "once you're free", "if that's alright"])
def test_politeness_is_no_condition(polite):
    assert kinds(f"{polite}, put the red cube in the bowl") == []


@pytest.mark.parametrize("event", ["if you can see smoke", "when you have a second tin", "once you're called"])
def test_a_condition_that_begins_like_politeness_is_one(event):
    assert kinds(f"{event}, put the red cube in the bowl") == ["condition"]


@pytest.mark.parametrize(
    ("objects", "found"),
    [(("red_tin", "green_tin", "red_cube"), []), (("red_tin", "green_tin", "blue_tin"), ["exclusion"])],
)
def test_a_negated_description_must_leave_one_object(objects, found):
    assert kinds("grasp the tin that is not red", objects) == found


def test_a_negated_description_in_unknown_words_is_a_clause():
    assert kinds("grasp the tin that is not sticky") == ["exclusion"]


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("I'll be back in five minutes, put the red cube in the bowl", []),
        ("I have been asking for hours, put the red cube in the bowl", []),
        ("I'll be back in five minutes, then put the red cube in the bowl", ["time"]),
        ("I want the red cube in the bowl in five minutes", ["time"]),
    ],
)
def test_a_remark_about_others_is_no_clause_unless_the_request_depends_on_it(text, found):
    assert kinds(text) == found


@pytest.mark.parametrize(
    "text", ["put the red cube on the green tin", "drop the red tin in the glass", "put it on the tin"]
)
def test_an_object_is_no_destination(text):
    assert kinds(text) == ["relative place"]
    assert kinds(text, graspable=()) == []  # the objects are not known
    assert kinds(text, receptive=(*PLACES, "green_tin", "clear_glass")) == []


def test_an_object_that_describes_another_one_is_no_destination():
    assert kinds("put the red cube on the green tin into the bowl") == []


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("when gripping the glass, be gentle, and put it on the left", []),
        ("when gripping the glass, hum a song, and put it on the left", ["condition"]),
    ],
)
def test_a_manner_may_belong_to_an_action_of_the_robot(text, found):
    assert kinds(text) == found


@pytest.mark.parametrize("text", ["give the red cube to Anna", "take the glass over to Tom, please"])
def test_a_recipient_may_have_a_name(text):
    assert kinds(text) == ["handing over"]
    assert kinds(text.lower()) == []  # "anna" may be a place that the robot does not know


def test_a_name_of_the_scene_is_no_recipient():
    assert kinds("take the cube to Shelf", receptive=("shelf",)) == []


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("after the green tin, put the red cube in the bowl", []),
        ("after the news starts, put the red cube in the bowl", ["time"]),
    ],
)
def test_only_a_name_of_the_scene_is_an_action_of_the_robot(text, found):
    assert kinds(text) == found
