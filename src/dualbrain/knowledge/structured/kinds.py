"""Checks of a document against its kind."""

from __future__ import annotations

from dualbrain.knowledge.document import DOCUMENT_KINDS, DocumentKind
from dualbrain.knowledge.readers.reader import DocumentText
from dualbrain.knowledge.rejection import DocumentRejected
from dualbrain.knowledge.structured.maps import RoomMap
from dualbrain.knowledge.structured.parsing import declared_kind, parse_structured
from dualbrain.knowledge.structured.templates import TaskTemplates

_FIX = "Correct the file, or name its kind with --kind."


def default_kind(document_text: DocumentText) -> DocumentKind | DocumentRejected:
    """The kind that a document declares; "manual" if it declares none.

    A TOML or JSON document that cannot be parsed, or that declares an unknown kind, is rejected: it may be a map or a
    template with a mistake.
    """
    declared = declared_kind(document_text)
    if isinstance(declared, DocumentRejected):
        return DocumentRejected(declared.what, declared.got, declared.allowed, _FIX)
    if declared and declared not in DOCUMENT_KINDS:
        return DocumentRejected("kind", ascii(declared[:60])[1:-1], ", ".join(DOCUMENT_KINDS), _FIX)
    return declared or "manual"


def check_structure(kind: DocumentKind, document_text: DocumentText) -> DocumentRejected | None:
    """The reason why `document_text` cannot be a document of this `kind`; None if it can."""
    if kind in {"map", "template"}:
        found = parse_structured(document_text, RoomMap if kind == "map" else TaskTemplates)
        return found if isinstance(found, DocumentRejected) else None
    return None
