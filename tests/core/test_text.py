"""Every text of a planner has a printable form: bounded, in plain ASCII, with look-alike letters escaped."""

import json

from hypothesis import given, settings
from hypothesis import strategies as st

from dualbrain.core.text import (
    MAX_PRINTED_LENGTH,
    closest_name_hint,
    count_noun,
    json_pointer,
    to_printable,
)


@settings(deadline=None)
@given(st.text(max_size=200))
def test_a_printable_string_is_short_ascii(text: str) -> None:
    safe = str(to_printable(text))
    assert safe.isascii()
    assert safe.isprintable()
    assert len(safe) < MAX_PRINTED_LENGTH + 30
    if text.isascii() and text.isprintable() and len(text) <= MAX_PRINTED_LENGTH and not set("'\\") & set(text):
        assert safe == text


def test_a_look_alike_letter_is_escaped() -> None:
    assert to_printable("grаsp") == "gr\\u0430sp"
    assert to_printable("x" * 1000) == "x" * 64 + "... (1000 characters)"


def test_a_container_is_replaced_by_its_size() -> None:
    assert (to_printable({"a": "secret"}), to_printable([1, 2])) == ("object of 1", "array of 2")
    assert [to_printable(value) for value in (None, True, 3, 0.5)] == [None, True, 3, 0.5]


def test_the_hint_has_the_closest_name_or_all_names() -> None:
    assert closest_name_hint("red_qube", ("red_cube", "bowl")) == "closest: 'red_cube'"
    assert closest_name_hint("zzz", ("red_cube", "bowl")) == "known: red_cube, bowl"
    assert closest_name_hint("zzz", ()) == "known: none"


def test_pointers_are_escaped_as_in_rfc_6901() -> None:
    assert json_pointer() == ""
    assert json_pointer("action_sequence", 0, "a/b~c") == "/action_sequence/0/a~1b~0c"
    assert json.dumps(json_pointer("\x1b[2J")) == '"/\\\\x1b[2J"'


def test_a_count_has_the_noun_in_its_number():
    assert [count_noun(n, "chunk") for n in (0, 1, 2)] == ["0 chunks", "1 chunk", "2 chunks"]
    assert [count_noun(n, "memory", "memories") for n in (1, 3)] == ["1 memory", "3 memories"]
