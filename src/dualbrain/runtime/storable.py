"""Text from outside as it can be written down: every record is UTF-8, and none grows without bound."""

from __future__ import annotations

LONGEST = 1 << 16
"""Characters of a text that are kept; the gate reads no contract longer than this."""


def storable(text: str, limit: int = LONGEST) -> str:
    """`text` with lone surrogates replaced by U+FFFD, cut after `limit` characters with a word on its full length."""
    kept = text[:limit].encode("utf-16-le", "surrogatepass").decode("utf-16-le", "replace")
    return kept if len(text) <= limit else f"{kept}… ({len(text)} characters)"
