"""No text for people contains a character that they do not see, or that controls the terminal or the page."""

import json
import unicodedata

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dualbrain.core.untrusted.hidden_characters import is_hidden_character
from dualbrain.core.untrusted.visible_text import replace_hidden, visible_text
from tests.support.growth import growth_of_cost

HIDDEN = (
    "\x00\x07\x08\x0b\x0c\r\x1b\x7f\x80\x85\x9b\x9f\xad\u034f\u061c\u115f\u1160\u17b4\u17b5\u180b\u180c\u180d\u180e\u180f"
    "\u200b\u200c\u200d\u200e\u200f\u2028\u2029\u202a\u202b\u202c\u202d\u202e\u2060\u2064\u2066\u2067\u2068\u2069\u206a"
    "\u206f\u2800\u3164\ufe00\ufe0f\ufeff\uffa0\ufff9\ufffa\ufffb\ufffe\uffff\ud800\udfff\ue000\uf8ff\u0378"
    "\U0001d159\U0001d173\U000e0001\U000e0041\U000e007f\U000e0100\U000e01ef\U000f0000\U0010ffff"
)
TERMINAL_ATTACKS = (
    "\x1b[2J\x1b[H",
    "\x1b]0;title\x07",
    "\x1b]8;;http://evil.example\x07click\x1b]8;;\x07",
    "\x1b]52;c;ZWNobw==\x07",
    "\x9b2J",
    "good\rbad",
    "bad\x08\x08\x08good",
    "\x1bP+q\x1b\\",
    "\u202egnp.exe",
    "a" + "".join(chr(0xE0100 + value) for value in b"smuggled words"),
    "".join(chr(0xE0000 + value) for value in b"tag characters"),
)


@pytest.mark.parametrize("character", HIDDEN, ids=lambda one: f"{ord(one):04x}")
def test_a_hidden_character_is_shown_by_its_number(character: str) -> None:
    assert is_hidden_character(character)
    shown = visible_text(f"a{character}b", keep_lines=True)
    assert shown.startswith("a\\u")
    assert shown.isascii()
    assert replace_hidden(f"a{character}b") == "a\ufffdb"
    assert json.loads(f'"{shown}"') == f"a{character}b"


@pytest.mark.parametrize(
    "text",
    ["", "put it down", "größe 5 µm → ‖BA‖ ≥ 0", "日本語 한국어 العربية עברית हिन्दी", "é\u0301", "emoji 🤖", "a\xa0b"],
)
def test_visible_text_is_not_changed(text: str) -> None:
    assert visible_text(text) == replace_hidden(text) == text


def test_line_ends_are_kept_only_where_they_are_wanted() -> None:
    assert visible_text("a\r\nb\n\tc\rd", keep_lines=True) == "a\nb\n\tc\\u000dd"
    assert visible_text("a\nb\tc") == "a\\u000ab\\u0009c"
    assert replace_hidden("a\nb") == "a\ufffdb"


@given(st.text())
def test_the_result_has_no_hidden_character_and_can_be_encoded(text: str) -> None:
    shown = visible_text(text)
    assert not any(is_hidden_character(one) for one in shown)
    assert not any(unicodedata.category(one) in ("Cc", "Cf", "Cs", "Co", "Cn", "Zl", "Zp") for one in shown)
    assert visible_text(shown) == shown
    shown.encode()


@given(
    st.recursive(st.text() | st.none() | st.integers(), lambda part: st.lists(part) | st.dictionaries(st.text(), part))
)
def test_json_keeps_its_meaning(value: object) -> None:
    text = json.dumps(value, ensure_ascii=False)
    assert json.loads(visible_text(text, keep_lines=True)) == value


@pytest.mark.parametrize("unit", ["\x1b", "\u202e", "é", "\r\n", "a", "\U000e0041"])
def test_the_cost_is_linear(unit: str) -> None:
    assert growth_of_cost(lambda size: visible_text(unit * (size // len(unit)), keep_lines=True), 1 << 14) < 2.0


@pytest.mark.parametrize("attack", TERMINAL_ATTACKS)
def test_every_attack_on_a_terminal_is_inert(attack: str) -> None:
    shown = visible_text(attack, keep_lines=True)
    assert shown.isprintable()
    assert "\\u" in shown
