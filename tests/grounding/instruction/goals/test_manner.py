"""The manner of an instruction: its words that are no part of the goal."""

import pytest

from dualbrain.grounding.instruction.goals.manner import Manner, read_manner

NAMES = {"red_cube", "blue_bowl"}
PLAIN = Manner(frozenset(), ())


def manner(words):
    return read_manner(words, NAMES)


@pytest.mark.parametrize(
    "words",
    [
        "put the red cube in the blue bowl",
        "Put the red cube in the blue bowl.",
        "could you please move the red cube over to the blue bowl?",
        "please be so kind as to set the red cube down in the blue bowl",
        "pick up the red cube and put it in the blue bowl",
        "the red cube should be in the blue bowl",
        "just drop the red cube, robot, into the blue bowl, thank you",
        "could you put the red cube into the blue bowl, please?",
        "would you mind moving that red cube over into the blue bowl?",
        "I would like to see the red cube in the blue bowl",
        "I need the red cube in the blue bowl, please.",
        "red cube: into the blue bowl with it",
    ],
)
def test_courtesy_and_verbs_of_a_placement_are_no_manner(words):
    assert manner(words) == PLAIN


@pytest.mark.parametrize(
    ("words", "cautions"),
    [
        ("carefully put the red cube in the blue bowl", {"carefully"}),
        ("put the red cube in the blue bowl, but slowly and with care", {"slowly", "with care"}),
        ("Slowly, and very gently, put the red cube in the blue bowl!", {"slowly", "very gently"}),
        ("put the red cube in the blue bowl, it must not tip over", {"it must not tip over"}),
    ],
)
def test_care_is_read_apart_from_other_words(words, cautions):
    assert manner(words) == Manner(frozenset(cautions), ())


@pytest.mark.parametrize(
    ("words", "left"),
    [
        ("quickly put the red cube in the blue bowl", ("quickly",)),
        ("push the red cube toward the blue bowl by 5 cm", ("push", "towards", "by", "5", "cm")),
        ("put the red cube in the blue bowl and wait 10 seconds", ("wait", "10", "seconds")),
        ("put the red cube in the blue bowl at 0.1 m/s", ("0.1", "m", "s")),
        ("put the red cube in the blue bowl from the side of the wall", ("from", "wall")),
        ("do not put the red cube in the blue bowl", ("do", "not")),
        ("I would like you to see the red cube in the blue bowl", ("see",)),
        ("I do not want the red cube in the blue bowl", ("i", "do", "not", "want")),
        ("put the red cube in the blue bowl with it upside down", ("with", "upside")),
    ],
)
def test_every_other_word_is_kept(words, left):
    assert manner(words) == Manner(frozenset(), left)


@pytest.mark.parametrize(
    ("words", "left"),
    [
        ("push cube_5 toward slot_10 by 10 cm", ("push", "towards", "by", "10", "cm")),
        ("push cube 5 toward slot 10 by 5 cm", ("push", "towards", "by", "5", "cm")),
        ("put cube_5 in slot_10", ()),
    ],
)
def test_a_number_of_a_name_is_left_out_only_within_the_name(words, left):
    assert read_manner(words, {"cube_5", "slot_10"}) == Manner(frozenset(), left)


def test_more_care_serves_and_less_does_not():
    careful = Manner(frozenset({"slowly"}), ())
    assert careful.serves(PLAIN)
    assert careful.serves(careful)
    assert not PLAIN.serves(careful)
    assert not careful.serves(Manner(frozenset({"gently"}), ()))
    assert not careful.serves(Manner(frozenset({"very slowly"}), ()))


def test_other_words_must_be_the_same_in_the_same_order():
    by_5, by_10, turned = (Manner(frozenset(), words) for words in (("by", "5"), ("by", "10"), ("5", "by")))
    assert by_5.serves(by_5)
    assert not by_5.serves(by_10)
    assert not by_5.serves(turned)
    assert not by_5.serves(PLAIN)
    assert not PLAIN.serves(by_5)
