"""Description files come from strangers: what is read of them, and what is refused before anything reads it.

No document type (so no entities, neither expanding nor external), no network, bounded size, well-formed as it stands.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from dualbrain.errors import ConfigurationError
from dualbrain.robots.optional_imports import import_optional

MAX_DESCRIPTION_BYTES = 32 * 2**20
"""Bytes of a description file."""


def read_bounded(path: Path, max_bytes: int = MAX_DESCRIPTION_BYTES) -> bytes:
    """The content of `path`, if it is a regular file of at most `most` bytes.

    Raises:
        InvalidSetup: there is no such file, or it is larger.
    """
    if not path.is_file():
        raise ConfigurationError("file", got=str(path), allowed="a file that is there")
    size = path.stat().st_size
    if size > max_bytes:
        raise ConfigurationError(f"size of {path.name}", got=f"{size} bytes", allowed=f"at most {max_bytes}")
    return path.read_bytes()


def read_xml(path: Path) -> tuple[bytes, Any]:
    """The bytes of `path` and its root element, which knows the line of every element.

    Raises:
        InvalidSetup: it is not well-formed (with line and column), or it declares a document type or entities.
        MissingPart: lxml is not installed.
    """
    data = read_bounded(path)
    return data, parse_xml(data, path.name)


def parse_xml(data: bytes, name: str) -> Any:
    """The root element of `data`; see `read_xml`."""
    if (found := data.find(b"<!DOCTYPE")) >= 0:
        raise _doctype_error(name, data[found : found + 80].decode(errors="replace"))
    etree = import_optional("lxml.etree")
    parser = etree.XMLParser(
        resolve_entities=False, no_network=True, load_dtd=False, dtd_validation=False, huge_tree=False
    )
    try:
        root = etree.fromstring(data, parser)
    except etree.XMLSyntaxError as error:
        line, column = error.position
        raise ConfigurationError(
            f"{name}, line {line}, column {column}", got=error.msg, allowed="well-formed XML"
        ) from error
    if root.getroottree().docinfo.doctype:  # in an encoding in which the bytes did not show it
        raise _doctype_error(name, root.getroottree().docinfo.doctype[:80])
    return root


def _doctype_error(name: str, got: str) -> ConfigurationError:
    return ConfigurationError(
        f"document type of {name}",
        got=got,
        allowed="none: a description needs no entities, and they can expand without bound or read other files",
        fix="Remove the <!DOCTYPE …>.",
    )
