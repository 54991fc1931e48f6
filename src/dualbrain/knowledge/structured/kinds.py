"""What a document of each kind must be."""

from __future__ import annotations

from dualbrain.knowledge.document import DOCUMENT_KINDS, DocumentKind
from dualbrain.knowledge.readers.reader import DocumentText
from dualbrain.knowledge.rejection import DocumentRejected
from dualbrain.knowledge.structured.maps import RoomMap
from dualbrain.knowledge.structured.parsing import declared_kind, parse_structured
from dualbrain.knowledge.structured.templates import TaskTemplates


def default_kind(reading: DocumentText) -> DocumentKind:
    """What a document says that it is; a manual if it says nothing."""
    said = declared_kind(reading)
    return said if said in DOCUMENT_KINDS else "manual"


def check_structure(kind: DocumentKind, reading: DocumentText) -> DocumentRejected | None:
    """Why `reading` cannot be a document of this `kind`, None if it can."""
    if kind in {"map", "template"}:
        found = parse_structured(reading, RoomMap if kind == "map" else TaskTemplates)
        return found if isinstance(found, DocumentRejected) else None
    return None
