"""A decoding schema in words that llama.cpp's own grammars know: for its servers and for Ollama, which has them too."""

from __future__ import annotations

import re
from typing import Any

from dualbrain.core.text import HIDDEN_CHARACTERS
from dualbrain.planner.decoding.llguidance_grammar import strip_annotations

_TEXT_PATTERN = re.compile(re.escape(f"^[^{HIDDEN_CHARACTERS}]{{0,") + r"(\d+)" + re.escape("}$"))
"""The pattern of a text for people: which characters it must not hold, and how many it may."""


def replace_text_patterns(schema: dict[str, Any]) -> dict[str, Any]:
    """`schema`, narrowed, with texts bound by their length alone.

    The hidden characters of their pattern begin with U+0000, and a grammar with that in it does not parse: the server
    answers every question with status 400. What a text may not hold is then left to the gate.
    """
    return _replace_patterns(strip_annotations(schema))


def _replace_patterns(narrowed: Any) -> Any:
    match narrowed:
        case {"pattern": str(pattern)} if found := _TEXT_PATTERN.fullmatch(pattern):
            return {"type": "string", "maxLength": int(found[1])}
        case dict():
            return {name: _replace_patterns(value) for name, value in narrowed.items()}
        case list():
            return [_replace_patterns(item) for item in narrowed]
        case _:
            return narrowed
