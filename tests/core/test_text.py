"""Whatever a planner wrote can be shown: bounded, in plain ASCII, look-alikes told apart."""

import json
import unicodedata

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dualbrain.core.text import LONGEST_SHOWN, closest, hides_something, pointer, shown


@settings(deadline=None)
@given(st.text(max_size=200))
def test_a_shown_string_is_short_printable_ascii(text: str) -> None:
    safe = str(shown(text))
    assert safe.isascii()
    assert safe.isprintable()
    assert len(safe) < LONGEST_SHOWN + 30
    if text.isascii() and text.isprintable() and len(text) <= LONGEST_SHOWN and not set("'\\") & set(text):
        assert safe == text


def test_a_look_alike_letter_shows() -> None:
    assert shown("grаsp") == "gr\\u0430sp"
    assert shown("x" * 1000) == "x" * 64 + "... (1000 characters)"


def test_a_container_shows_only_its_size() -> None:
    assert (shown({"a": "secret"}), shown([1, 2])) == ("object of 1", "array of 2")
    assert [shown(value) for value in (None, True, 3, 0.5)] == [None, True, 3, 0.5]


@settings(deadline=None)
@given(st.characters(categories=["Cc", "Zl", "Zp"]))
def test_control_characters_and_line_breaks_hide(character: str) -> None:
    assert hides_something(f"a{character}b")


@pytest.mark.parametrize("character", ["\u200b", "\u202e", "\u2066", "\ufeff", "\U000e0041", "\u2060", "\x1b"])
def test_invisible_and_turning_characters_hide(character: str) -> None:
    assert unicodedata.category(character) in ("Cf", "Cc")
    assert hides_something(character)


@pytest.mark.parametrize("text", ["the cup is out of reach", "Größe 3 °", "手が届かない", "naïve — “quoted”"])
def test_plain_words_of_any_language_hide_nothing(text: str) -> None:
    assert not hides_something(text)


def test_the_closest_name_or_all_of_them() -> None:
    assert closest("red_qube", ("red_cube", "bowl")) == "closest: 'red_cube'"
    assert closest("zzz", ("red_cube", "bowl")) == "known: red_cube, bowl"
    assert closest("zzz", ()) == "known: none"


def test_pointers_escape_as_the_standard_says() -> None:
    assert pointer() == ""
    assert pointer("action_sequence", 0, "a/b~c") == "/action_sequence/0/a~1b~0c"
    assert json.dumps(pointer("\x1b[2J")) == '"/\\\\x1b[2J"'
