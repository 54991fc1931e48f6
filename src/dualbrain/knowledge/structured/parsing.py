"""Maps and templates are documents with a structure: TOML or JSON that says `kind = "map"` or `kind = "template"`."""

from __future__ import annotations

import json
import tomllib
from typing import Any, TypeVar, cast

import msgspec

from dualbrain.knowledge.readers.reader import Reading
from dualbrain.knowledge.rejection import Refused

T = TypeVar("T")
DEEPEST = 16
"""Brackets within brackets."""


def structure(reading: Reading, what: type[T]) -> T | Refused:
    """The reading as a `what`, with every field that it must have and no other."""
    raw = fields(reading)
    if isinstance(raw, Refused):
        return raw
    try:
        return msgspec.convert(raw, what)
    except msgspec.ValidationError as error:
        return Refused(f"a {raw.get('kind', 'document')}", str(error), f"the fields of {what.__name__}")
    except ValueError as error:
        return Refused(f"a {raw.get('kind', 'document')}", str(error), f"a sound {what.__name__}")


def fields(reading: Reading) -> dict[str, Any] | Refused:
    """The top-level fields of a TOML or JSON document."""
    if reading.media not in {"toml", "json"}:
        return Refused("format of a map or template", reading.media, "toml or json")
    depth = deepest = 0
    for character in reading.text:
        depth += (character in "[{") - (character in "]}")
        deepest = max(deepest, depth)
    if deepest > DEEPEST:
        return Refused("nesting", f"{deepest} levels", f"{DEEPEST} levels")
    try:
        found: Any = (tomllib if reading.media == "toml" else json).loads(reading.text)
    except ValueError as error:
        return Refused(f"broken {reading.media}", str(error)[:200], f"valid {reading.media}")
    if isinstance(found, dict):
        return cast("dict[str, Any]", found)
    return Refused("a document", type(found).__name__, "fields with names")


def declared_kind(reading: Reading) -> str:
    """The `kind` that a TOML or JSON document gives itself, "" if it gives none."""
    found = fields(reading) if reading.media in {"toml", "json"} else {}
    return "" if isinstance(found, Refused) else str(found.get("kind", ""))
