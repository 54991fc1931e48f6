"""Text from outside that people will read: which characters it may hold, and how any value is shown safely."""

from __future__ import annotations

import re
from collections.abc import Mapping
from difflib import get_close_matches
from typing import Any, cast

HIDDEN_CHARACTERS = "\x00-\x1f\x7f-\x9f\u200b-\u200f\u2028-\u202e\u2060-\u206f\ufeff\U000e0000-\U000e007f"
"""Body of a character class: control characters (terminal escapes), zero-width, direction overrides and tag characters,
which change what a reader sees or carry words that no reader sees."""

MAX_PRINTED_LENGTH = 64

_HIDDEN_PATTERN = re.compile(f"[{HIDDEN_CHARACTERS}]")

PrintableValue = str | int | float | bool | None


def has_hidden_characters(text: str) -> bool:
    """Whether `text` holds a character that a reader could not see as what it is."""
    return _HIDDEN_PATTERN.search(text) is not None


def to_printable(value: object) -> PrintableValue:
    """`value` in a form that is safe to print and bounded.

    A string comes in ASCII escapes, so that a look-alike letter shows, and at most 64 of them; of an object or array
    only the size is told.
    """
    if value is None or isinstance(value, (bool, int, float)):
        return value
    if isinstance(value, str):
        safe = ascii(value[: MAX_PRINTED_LENGTH + 1])[1:-1]
        return safe if len(safe) <= MAX_PRINTED_LENGTH else f"{safe[:MAX_PRINTED_LENGTH]}... ({len(value)} characters)"
    if isinstance(value, dict):
        return f"object of {len(cast('dict[str, object]', value))}"
    if isinstance(value, list):
        return f"array of {len(cast('list[object]', value))}"
    return type(value).__name__


def closest_name_hint(name: str, known: tuple[str, ...]) -> str:
    """`closest: 'red_cube'`, or the known names when none is near."""
    near = get_close_matches(name[:MAX_PRINTED_LENGTH], known, n=1)
    return f"closest: {near[0]!r}" if near else f"known: {', '.join(known) or 'none'}"


def json_pointer(*parts: str | int) -> str:
    """JSON pointer (RFC 6901) to a place in the contract; a key that is not plain is shown as by `shown`."""
    return "".join("/" + str(to_printable(part)).replace("~", "~0").replace("/", "~1") for part in parts)


def make_json_safe(value: Any) -> Any:
    """The same value without what JSON in UTF-8 cannot hold: lone surrogates become U+FFFD, huge integers words."""
    match value:
        case str() if value.isascii():
            return value
        case str():
            return value.encode("utf-16-le", "surrogatepass").decode("utf-16-le", "replace")
        case dict():
            return {make_json_safe(key): make_json_safe(item) for key, item in cast("dict[str, Any]", value).items()}
        case list() | tuple():
            return [make_json_safe(item) for item in cast("list[Any]", value)]
        case int() if value.bit_length() > 63:
            return f"an integer of {value.bit_length()} bits"
        case _:
            return value


MAX_STORED_CHARACTERS = 1 << 16
"""Characters of a text that are kept; the gate reads no contract longer than this."""


def storable_text(text: str, limit: int = MAX_STORED_CHARACTERS) -> str:
    """`text` with lone surrogates replaced by U+FFFD, cut after `limit` characters with a word on its full length."""
    kept = text[:limit].encode("utf-16-le", "surrogatepass").decode("utf-16-le", "replace")
    return kept if len(text) <= limit else f"{kept}… ({len(text)} characters)"


def describe_differences(recorded: Mapping[str, object], current: Mapping[str, object]) -> str:
    """Each part of which both tell, and not the same; "" if there is none."""
    found = [(name, value, current[name]) for name, value in recorded.items() if current.get(name, value) != value]
    return "; ".join(f"{name} {theirs}, now {ours}" for name, theirs, ours in found)
