"""Values made fit for JSON in UTF-8, in plain sight."""

from __future__ import annotations

from typing import Any, cast


def clean(value: Any) -> Any:
    """The same value without what JSON in UTF-8 cannot hold: lone surrogates become U+FFFD, huge integers words."""
    match value:
        case str() if value.isascii():
            return value
        case str():
            return value.encode("utf-16-le", "surrogatepass").decode("utf-16-le", "replace")
        case dict():
            return {clean(key): clean(item) for key, item in cast("dict[str, Any]", value).items()}
        case list() | tuple():
            return [clean(item) for item in cast("list[Any]", value)]
        case int() if value.bit_length() > 63:
            return f"an integer of {value.bit_length()} bits"
        case _:
            return value
