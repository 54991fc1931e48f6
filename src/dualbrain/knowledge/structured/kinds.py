"""What a document of each kind must be."""

from __future__ import annotations

from dualbrain.knowledge.document import KINDS, Kind
from dualbrain.knowledge.readers.reader import Reading
from dualbrain.knowledge.rejection import Refused
from dualbrain.knowledge.structured.maps import RoomMap
from dualbrain.knowledge.structured.parsing import declared_kind, structure
from dualbrain.knowledge.structured.templates import TaskTemplates


def default_kind(reading: Reading) -> Kind:
    """What a document says that it is; a manual if it says nothing."""
    said = declared_kind(reading)
    return said if said in KINDS else "manual"


def check_structure(kind: Kind, reading: Reading) -> Refused | None:
    """Why `reading` cannot be a document of this `kind`, None if it can."""
    if kind in {"map", "template"}:
        found = structure(reading, RoomMap if kind == "map" else TaskTemplates)
        return found if isinstance(found, Refused) else None
    return None
