"""The one list of hidden characters: what a reader of a text does not see, or does not see as itself.

Hidden are control characters, format characters (zero-width, direction, soft hyphen, tags, annotations), private-use,
unassigned and noncharacter code points, lone surrogates, line and paragraph separators, variation selectors, and
letters that are displayed as nothing (fillers, the blank Braille pattern, the combining grapheme joiner). Gate,
prompts, documents and reports use this list and no other.

`HIDDEN_CHARACTERS` is the part that does not depend on the version of Unicode; single unassigned code points between
assigned ones are found by category.
"""

from __future__ import annotations

import re
import unicodedata
from functools import cache

_HIDDEN_RANGES = (
    (0x0000, 0x001F),  # controls
    (0x007F, 0x009F),  # controls
    (0x00AD, 0x00AD),  # soft hyphen
    (0x034F, 0x034F),  # combining grapheme joiner
    (0x0600, 0x0605),  # number signs of Arabic, format characters
    (0x061C, 0x061C),  # direction mark
    (0x06DD, 0x06DD),
    (0x070F, 0x070F),
    (0x0890, 0x0891),
    (0x08E2, 0x08E2),
    (0x115F, 0x1160),  # fillers of Hangul
    (0x17B4, 0x17B5),  # inherent vowels of Khmer, without a form
    (0x180B, 0x180F),  # variation selectors and vowel separator of Mongolian
    (0x200B, 0x200F),  # zero-width characters and direction marks
    (0x2028, 0x202E),  # separators of lines and paragraphs, direction overrides
    (0x2060, 0x206F),  # invisible operators, direction isolates
    (0x2800, 0x2800),  # blank pattern of Braille
    (0x3164, 0x3164),  # filler of Hangul
    (0xE000, 0xF8FF),  # private use
    (0xFDD0, 0xFDEF),  # noncharacters
    (0xFE00, 0xFE0F),  # variation selectors
    (0xFEFF, 0xFEFF),  # byte order mark
    (0xFFA0, 0xFFA0),  # filler of Hangul, half width
    (0xFFF0, 0xFFFB),  # unassigned, annotations
    (0xFFFE, 0xFFFF),  # noncharacters
    (0x110BD, 0x110BD),
    (0x110CD, 0x110CD),
    (0x13430, 0x1343F),  # format controls of hieroglyphs
    (0x1BCA0, 0x1BCA3),  # format controls of shorthand
    (0x1D159, 0x1D159),  # note head without a form
    (0x1D173, 0x1D17A),  # format controls of music
    (0x1FFFE, 0x1FFFF),
    (0x2FFFE, 0x2FFFF),
    (0x3FFFE, 0xE0FFF),  # unassigned planes, tags, variation selectors
    (0xE1000, 0x10FFFF),  # unassigned, private use, noncharacters
)
_HIDDEN_CATEGORIES = frozenset({"Cc", "Cf", "Co", "Cs", "Cn", "Zl", "Zp"})
_MAX_CODE_POINT = 0x10FFFF
_SURROGATES = range(0xD800, 0xE000)


def _class_body(ranges: tuple[tuple[int, int], ...]) -> str:
    return "".join(chr(first) if first == last else f"{chr(first)}-{chr(last)}" for first, last in ranges)


HIDDEN_CHARACTERS = _class_body(_HIDDEN_RANGES)
"""Body of a regular expression's character class: the hidden characters in every version of Unicode."""
_HIDDEN_PATTERN = re.compile(f"[{HIDDEN_CHARACTERS}]")


def is_hidden_character(character: str) -> bool:
    """Whether the one `character` is not displayed as itself; true for line feeds and tabs, too."""
    return _HIDDEN_PATTERN.match(character) is not None or unicodedata.category(character) in _HIDDEN_CATEGORIES


def has_hidden_characters(text: str, *, allowed: str = "") -> bool:
    """Whether `text` contains a hidden character that is not among the `allowed` ones."""
    if text.isascii() and not allowed:
        return _HIDDEN_PATTERN.search(text) is not None
    return any(character not in allowed and is_hidden_character(character) for character in set(text))


def remove_hidden_characters(text: str, *, replacement: str = "", allowed: str = "") -> str:
    """`text` with `replacement` in place of each hidden character that is not among the `allowed` ones."""
    hidden = [character for character in set(text) if character not in allowed and is_hidden_character(character)]
    return text.translate(dict.fromkeys(map(ord, hidden), replacement)) if hidden else text


@cache
def every_hidden_character() -> str:
    """Body of a character class with exactly the characters of `is_hidden_character`, apart from lone surrogates.

    It depends on the version of Unicode in Python and is long (about 700 ranges).
    """
    ranges: list[tuple[int, int]] = []
    for code in range(_MAX_CODE_POINT + 1):
        if code in _SURROGATES or not is_hidden_character(chr(code)):
            continue
        if ranges and ranges[-1][1] == code - 1:
            ranges[-1] = (ranges[-1][0], code)
        else:
            ranges.append((code, code))
    return _class_body(tuple(ranges))
