"""Sanitising of external text (from people, perception, memory) for a block of the prompt.

A block is `<tag>`, lines, `</tag>`. Law: sanitised text contains neither `<` nor `>`, so no input can close its block,
open another one, or form a control token of a chat template (`<|im_end|>`, `</s>`, `<start_of_turn>`), which servers
parse even inside a message. Square brackets are replaced, too, because some templates mark turns with `[INST]`.
"""

from __future__ import annotations

import json
import re
import unicodedata
from typing import Any

from dualbrain.core.untrusted.hidden_characters import remove_hidden_characters

MAX_STRING_CHARACTERS = 160
"""Largest length of one string in external JSON."""

_REPLACEMENTS = (("->", " to "), ("<", " under "), (">", " over "), ("[", "("), ("]", ")"))


def sanitize(text: str, *, limit: int, lines: int = 1) -> str:
    """`text` in at most `limit` characters and `lines` lines, without invisible and delimiting characters.

    Compatibility forms are normalised first (NFKC), so that full-width brackets count as brackets. The function is
    idempotent up to the length limit; a text that is cut ends in "...".
    """
    normalized = unicodedata.normalize("NFKC", text[: 4 * limit])
    rows = [_clean_line(row) for row in re.split(r"[\n\r\u2028\u2029]+", normalized)]
    kept = [row for row in rows if row]
    joined = "\n".join((*kept[: lines - 1], " ".join(kept[lines - 1 :]))).strip()
    return joined if len(joined) <= limit else joined[: max(limit - 3, 0)].rstrip() + "..."


def format_block(tag: str, text: str, *, limit: int, lines: int = 1) -> str:
    """`text`, sanitised, between `<tag>` and `</tag>`."""
    return f"<{tag}>\n{sanitize(text, limit=limit, lines=lines) or '(empty)'}\n</{tag}>"


def compact_json(value: Any, *, limit: int) -> str:
    """`value` as one line of ASCII JSON with sanitised strings; "" if it is not JSON or longer than `limit`."""
    try:
        text = json.dumps(_clean_value(value), separators=(",", ":"), allow_nan=False)
    except (TypeError, ValueError, RecursionError):
        return ""
    return text if len(text) <= limit else ""


def _clean_line(row: str) -> str:
    for mark, word in _REPLACEMENTS:
        row = row.replace(mark, word)
    return " ".join(remove_hidden_characters(row, replacement=" ").split())


def _clean_value(value: Any) -> Any:
    match value:
        case str():
            return sanitize(value, limit=MAX_STRING_CHARACTERS)
        case dict():
            return {sanitize(str(key), limit=MAX_STRING_CHARACTERS): _clean_value(item) for key, item in value.items()}
        case list() | tuple():
            return [_clean_value(item) for item in value]
        case _:
            return value
