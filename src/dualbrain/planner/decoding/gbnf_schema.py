"""Decoding schemas for the grammar engine of llama.cpp, which its servers and Ollama use."""

from __future__ import annotations

import re
from typing import Any

from dualbrain.core.untrusted.hidden_characters import HIDDEN_CHARACTERS
from dualbrain.planner.decoding.llguidance_grammar import strip_annotations

_TEXT_PATTERN = re.compile(re.escape(f"^[^{HIDDEN_CHARACTERS}]{{0,") + r"(\d+)" + re.escape("}$"))
"""The pattern of a text for people: its excluded characters and its largest length."""


def replace_text_patterns(schema: dict[str, Any]) -> dict[str, Any]:
    """`schema` without annotations, with texts limited by their length alone.

    The excluded characters in the pattern of a text begin with U+0000. A grammar with this character does not parse,
    and the server answers every request with status 400. The gate rejects texts with excluded characters.
    """
    return _replace_patterns(strip_annotations(schema))


def _replace_patterns(schema: Any) -> Any:
    match schema:
        case {"pattern": str(pattern)} if found := _TEXT_PATTERN.fullmatch(pattern):
            return {"type": "string", "maxLength": int(found[1])}
        case dict():
            return {name: _replace_patterns(value) for name, value in schema.items()}
        case list():
            return [_replace_patterns(item) for item in schema]
        case _:
            return schema
