"""The list of hidden characters: all kinds that hide text are on it, and plain text of any language is not."""

import re
import unicodedata

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dualbrain.core.untrusted.hidden_characters import (
    HIDDEN_CHARACTERS,
    every_hidden_character,
    has_hidden_characters,
    is_hidden_character,
    remove_hidden_characters,
)

HIDDEN = {
    "soft hyphen": "\u00ad",
    "grapheme joiner": "\u034f",
    "direction of Arabic": "\u061c",
    "filler of Hangul": "\u115f",
    "second filler": "\u1160",
    "vowel of Khmer": "\u17b4",
    "separator of Mongolian": "\u180e",
    "selector of Mongolian": "\u180b",
    "zero width": "\u200b",
    "override": "\u202e",
    "isolate": "\u2066",
    "unassigned operator": "\u2065",
    "blank Braille": "\u2800",
    "compatibility filler": "\u3164",
    "private use": "\ue000",
    "noncharacter": "\ufdd0",
    "last of the plane": "\uffff",
    "variation selector": "\ufe00",
    "emoji selector": "\ufe0f",
    "byte order mark": "\ufeff",
    "half-width filler": "\uffa0",
    "annotation": "\ufff9",
    "music": "\U0001d173",
    "language tag": "\U000e0001",
    "tag": "\U000e0041",
    "more selectors": "\U000e0100",
    "last selector": "\U000e01ef",
    "unassigned beside tags": "\U000e0fff",
    "unassigned plane": "\U000a0000",
    "private plane": "\U000f0000",
    "last code point": "\U0010ffff",
    "unassigned Greek": "\u0378",
    "escape": "\x1b",
    "surrogate": "\ud800",
}


@pytest.mark.parametrize("name", HIDDEN)
def test_each_kind_is_hidden_and_removed(name):
    text = f"a{HIDDEN[name]}b"
    assert has_hidden_characters(text)
    assert remove_hidden_characters(text) == "ab"
    assert remove_hidden_characters(text, replacement=" ") == "a b"


@pytest.mark.parametrize(
    "text",
    ["out of reach", "Größe 3 °", "手が届かない", "naïve — “quoted”", "가나다", "שלום", "مرحبا", "ไทย", "😀", "⠁⠃"],
)
def test_plain_text_of_any_language_is_not_hidden(text):
    assert not has_hidden_characters(text)
    assert remove_hidden_characters(text) == text


def test_allowed_characters_stay():
    assert not has_hidden_characters("a\n\tb", allowed="\n\t")
    assert has_hidden_characters("a\n\t\rb", allowed="\n\t")
    assert remove_hidden_characters("a\n\u200bb", allowed="\n") == "a\nb"


@settings(deadline=None)
@given(st.characters())
def test_no_character_of_a_category_without_form_is_visible(character):
    if unicodedata.category(character) in {"Cc", "Cf", "Co", "Cs", "Cn", "Zl", "Zp"}:
        assert is_hidden_character(character)


def test_the_class_of_a_schema_has_exactly_the_hidden_characters():
    complete, fixed = re.compile(f"[{every_hidden_character()}]"), re.compile(f"[{HIDDEN_CHARACTERS}]")
    for code in range(0x110000):
        hidden = is_hidden_character(chr(code))
        if not 0xD800 <= code < 0xE000:
            assert (complete.match(chr(code)) is not None) == hidden
        if fixed.match(chr(code)):
            assert hidden
