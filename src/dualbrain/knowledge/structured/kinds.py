"""Checks of a document against its kind."""

from __future__ import annotations

from dualbrain.knowledge.document import DOCUMENT_KINDS, DocumentKind
from dualbrain.knowledge.readers.reader import DocumentText
from dualbrain.knowledge.rejection import DocumentRejected
from dualbrain.knowledge.structured.maps import RoomMap
from dualbrain.knowledge.structured.parsing import declared_kind, parse_structured
from dualbrain.knowledge.structured.templates import TaskTemplates


def default_kind(document_text: DocumentText) -> DocumentKind:
    """The kind that a document declares; "manual" if it declares none."""
    declared = declared_kind(document_text)
    return declared if declared in DOCUMENT_KINDS else "manual"


def check_structure(kind: DocumentKind, document_text: DocumentText) -> DocumentRejected | None:
    """The reason why `document_text` cannot be a document of this `kind`; None if it can."""
    if kind in {"map", "template"}:
        found = parse_structured(document_text, RoomMap if kind == "map" else TaskTemplates)
        return found if isinstance(found, DocumentRejected) else None
    return None
