"""Safe handling of untrusted text: printable forms of values, JSON pointers, stored text.

The list of hidden characters is in `core.untrusted.hidden_characters`.
"""

from __future__ import annotations

from collections.abc import Mapping
from difflib import get_close_matches
from typing import Any, cast

from dualbrain.core.untrusted.hidden_characters import HIDDEN_CHARACTERS, has_hidden_characters  # noqa: F401

MAX_PRINTED_LENGTH = 64

PrintableValue = str | int | float | bool | None


def to_printable(value: object) -> PrintableValue:
    """A bounded form of `value` that is safe to print.

    A string is escaped to ASCII, which reveals look-alike letters, and cut after 64 characters; an object or array is
    replaced by its size.
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
    """The known name most similar to `name` (`closest: 'red_cube'`), or all known names if none is similar."""
    similar = get_close_matches(name[:MAX_PRINTED_LENGTH], known, n=1)
    return f"closest: {similar[0]!r}" if similar else f"known: {', '.join(known) or 'none'}"


def count_noun(count: int, noun: str, plural: str = "") -> str:
    """`count` with its noun: "1 chunk", "2 chunks"; `plural` (default: the noun with an s) serves all counts but 1."""
    return f"{count} {noun if count == 1 else plural or f'{noun}s'}"


def json_pointer(*parts: str | int) -> str:
    """JSON pointer (RFC 6901) to a value in the contract; each key is made printable by `to_printable`."""
    return "".join("/" + str(to_printable(part)).replace("~", "~0").replace("/", "~1") for part in parts)


def make_json_safe(value: Any) -> Any:
    """`value` without content that UTF-8 JSON cannot encode.

    Lone surrogates become U+FFFD, and an integer of more than 63 bits is replaced by a description of its size.
    """
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
"""Maximum number of characters of a stored text; the gate rejects a contract that is longer."""


def storable_text(text: str, limit: int = MAX_STORED_CHARACTERS) -> str:
    """`text` with lone surrogates replaced by U+FFFD, cut after `limit` characters; a cut text ends with its length."""
    kept = text[:limit].encode("utf-16-le", "surrogatepass").decode("utf-16-le", "replace")
    return kept if len(text) <= limit else f"{kept}… ({len(text)} characters)"


def describe_differences(recorded: Mapping[str, object], current: Mapping[str, object]) -> str:
    """The entries whose values differ, as "NAME OLD, now NEW"; "" if all entries in both mappings are equal."""
    found = [(name, value, current[name]) for name, value in recorded.items() if current.get(name, value) != value]
    return "; ".join(f"{name} {old}, now {new}" for name, old, new in found)
