"""Description files come from strangers: what is read of them, and what is refused before anything reads it.

No document type (so no entities, neither expanding nor external), no network, bounded size, well-formed as it stands.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from dualbrain.errors import InvalidSetup
from dualbrain.robots.optional_imports import extra

LARGEST = 32 * 2**20
"""Bytes of a description file."""


def read_bytes(path: Path, most: int = LARGEST) -> bytes:
    """The content of `path`, if it is a regular file of at most `most` bytes.

    Raises:
        InvalidSetup: there is no such file, or it is larger.
    """
    if not path.is_file():
        raise InvalidSetup("file", got=str(path), allowed="a file that is there")
    size = path.stat().st_size
    if size > most:
        raise InvalidSetup(f"size of {path.name}", got=f"{size} bytes", allowed=f"at most {most}")
    return path.read_bytes()


def read_xml(path: Path) -> tuple[bytes, Any]:
    """The bytes of `path` and its root element, which knows the line of every element.

    Raises:
        InvalidSetup: it is not well-formed (with line and column), or it declares a document type or entities.
        MissingPart: lxml is not installed.
    """
    data = read_bytes(path)
    return data, parse_xml(data, path.name)


def parse_xml(data: bytes, name: str) -> Any:
    """The root element of `data`; see `read_xml`."""
    if (found := data.find(b"<!DOCTYPE")) >= 0:
        raise _document_type(name, data[found : found + 80].decode(errors="replace"))
    etree = extra("lxml.etree")
    parser = etree.XMLParser(
        resolve_entities=False, no_network=True, load_dtd=False, dtd_validation=False, huge_tree=False
    )
    try:
        root = etree.fromstring(data, parser)
    except etree.XMLSyntaxError as error:
        line, column = error.position
        raise InvalidSetup(f"{name}, line {line}, column {column}", got=error.msg, allowed="well-formed XML") from error
    if root.getroottree().docinfo.doctype:  # in an encoding in which the bytes did not show it
        raise _document_type(name, root.getroottree().docinfo.doctype[:80])
    return root


def _document_type(name: str, got: str) -> InvalidSetup:
    return InvalidSetup(
        f"document type of {name}", got=got,
        allowed="none: a description needs no entities, and they can expand without bound or read other files",
        fix="Remove the <!DOCTYPE …>.",
    )  # fmt: skip
