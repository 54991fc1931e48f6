"""Parsing of structured documents: maps and templates are TOML or JSON with `kind = "map"` or `kind = "template"`."""

from __future__ import annotations

import json
from typing import Any, TypeVar, cast

import msgspec

from dualbrain.core.untrusted.toml_document import TomlFault, parse_toml
from dualbrain.knowledge.readers.reader import DocumentText
from dualbrain.knowledge.rejection import DocumentRejected

T = TypeVar("T")
MAX_NESTING = 16
"""Largest nesting of brackets."""
_WITHOUT_FIELDS = "a document"


def parse_structured(document_text: DocumentText, structure: type[T]) -> T | DocumentRejected:
    """The document text as a `structure`, which must have all required fields and no unknown ones."""
    raw = parse_fields(document_text)
    if isinstance(raw, DocumentRejected):
        return raw
    try:
        return msgspec.convert(raw, structure)
    except msgspec.ValidationError as error:
        return DocumentRejected(f"a {raw.get('kind', 'document')}", str(error), f"the fields of {structure.__name__}")
    except ValueError as error:
        return DocumentRejected(f"a {raw.get('kind', 'document')}", str(error), f"a valid {structure.__name__}")


def parse_fields(document_text: DocumentText) -> dict[str, Any] | DocumentRejected:
    """The top-level fields of a TOML or JSON document."""
    if document_text.media not in {"toml", "json"}:
        return DocumentRejected("format of a map or template", document_text.media, "toml or json")
    depth = deepest = 0
    for character in document_text.text:
        depth += (character in "[{") - (character in "]}")
        deepest = max(deepest, depth)
    if deepest > MAX_NESTING:
        return DocumentRejected("nesting", f"{deepest} levels", f"{MAX_NESTING} levels")
    found = parse_toml(document_text.text) if document_text.media == "toml" else _parse_json(document_text.text)
    if isinstance(found, TomlFault):
        found = f"line {found.line}, column {found.column}: {found.problem}"
    if isinstance(found, str):
        return DocumentRejected(f"broken {document_text.media}", found[:200], f"valid {document_text.media}")
    if isinstance(found, dict):
        return cast("dict[str, Any]", found)
    return DocumentRejected(_WITHOUT_FIELDS, type(found).__name__, "fields with names")


def _parse_json(text: str) -> Any:
    """The value of a JSON text (a string in a list), or its fault, as a string."""
    try:
        found: Any = json.loads(text)
    except (ValueError, RecursionError) as error:
        return str(error) or type(error).__name__
    return [found] if isinstance(found, str) else found


def declared_kind(document_text: DocumentText) -> str | DocumentRejected:
    """The `kind` that a TOML or JSON document declares, "" if it declares none; a rejection if it cannot be parsed."""
    if document_text.media not in {"toml", "json"}:
        return ""
    found = parse_fields(document_text)
    if isinstance(found, DocumentRejected):
        return "" if found.what == _WITHOUT_FIELDS else found
    return str(found.get("kind", ""))
