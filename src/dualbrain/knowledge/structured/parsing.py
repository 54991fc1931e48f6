"""Maps and templates are documents with a structure: TOML or JSON that says `kind = "map"` or `kind = "template"`."""

from __future__ import annotations

import json
import tomllib
from typing import Any, TypeVar, cast

import msgspec

from dualbrain.knowledge.readers.reader import DocumentText
from dualbrain.knowledge.rejection import DocumentRejected

T = TypeVar("T")
MAX_NESTING = 16
"""Brackets within brackets."""


def parse_structured(reading: DocumentText, what: type[T]) -> T | DocumentRejected:
    """The reading as a `what`, with every field that it must have and no other."""
    raw = parse_fields(reading)
    if isinstance(raw, DocumentRejected):
        return raw
    try:
        return msgspec.convert(raw, what)
    except msgspec.ValidationError as error:
        return DocumentRejected(f"a {raw.get('kind', 'document')}", str(error), f"the fields of {what.__name__}")
    except ValueError as error:
        return DocumentRejected(f"a {raw.get('kind', 'document')}", str(error), f"a sound {what.__name__}")


def parse_fields(reading: DocumentText) -> dict[str, Any] | DocumentRejected:
    """The top-level fields of a TOML or JSON document."""
    if reading.media not in {"toml", "json"}:
        return DocumentRejected("format of a map or template", reading.media, "toml or json")
    depth = deepest = 0
    for character in reading.text:
        depth += (character in "[{") - (character in "]}")
        deepest = max(deepest, depth)
    if deepest > MAX_NESTING:
        return DocumentRejected("nesting", f"{deepest} levels", f"{MAX_NESTING} levels")
    try:
        found: Any = (tomllib if reading.media == "toml" else json).loads(reading.text)
    except ValueError as error:
        return DocumentRejected(f"broken {reading.media}", str(error)[:200], f"valid {reading.media}")
    if isinstance(found, dict):
        return cast("dict[str, Any]", found)
    return DocumentRejected("a document", type(found).__name__, "fields with names")


def declared_kind(reading: DocumentText) -> str:
    """The `kind` that a TOML or JSON document gives itself, "" if it gives none."""
    found = parse_fields(reading) if reading.media in {"toml", "json"} else {}
    return "" if isinstance(found, DocumentRejected) else str(found.get("kind", ""))
