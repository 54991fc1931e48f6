"""Visible form of untrusted text for people: in reports, in the live view, in the terminal and in messages.

An instruction, a name in a scene, an answer of a model or a file can contain characters that a reader does not see and
that change what the reader sees or does: a terminal obeys escape sequences, direction marks reorder the text, and
selectors and fillers carry whole sentences without a trace. `visible_text` shows every such character by its number.
"""

from __future__ import annotations

import re
from functools import lru_cache

from dualbrain.core.untrusted.hidden_characters import is_hidden_character

_CANDIDATE = re.compile(r"[^ -~]")
"""Everything but printable ASCII, one character at a time, so that the search is linear."""


def visible_text(text: str, *, keep_lines: bool = False) -> str:
    r"""`text` with every hidden character as the escape of JSON (`\u202e`), which keeps JSON equivalent.

    With `keep_lines`, line ends and tabs stay; a carriage return, which overwrites a line in a terminal, does not.
    The function is idempotent, and its result can be encoded in UTF-8.
    """
    if text.isascii() and text.isprintable():
        return text
    kept = "\n\t" if keep_lines else ""
    if keep_lines:
        text = text.replace("\r\n", "\n")
    return _CANDIDATE.sub(lambda found: found[0] if found[0] in kept else _visible_form(found[0]), text)


def replace_hidden(text: str, replacement: str = "\N{REPLACEMENT CHARACTER}") -> str:
    """`text` with every hidden character replaced, for a cell of a table, whose width should not change."""
    return _CANDIDATE.sub(lambda found: replacement if is_hidden_character(found[0]) else found[0], text)


@lru_cache(maxsize=4096)
def _visible_form(character: str) -> str:
    if not is_hidden_character(character):
        return character
    units = character.encode("utf-16-be", "surrogatepass")
    return "".join(f"\\u{units[k]:02x}{units[k + 1]:02x}" for k in range(0, len(units), 2))
