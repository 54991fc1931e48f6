"""Safe XML reader for robot descriptions from untrusted sources.

The reader refuses document types (and with them all entities, expanding or external) and files above a size limit, uses
no network, and repairs nothing. The only error it accepts is a namespace prefix that is not declared, which robot
descriptions use for extensions of one tool (`drake:acceleration`): such a name is put into a namespace of its own
(`undeclared_namespace`), so that readers ignore it unless they ask for it.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, NoReturn
from urllib.parse import quote
from xml.parsers import expat

import msgspec

from dualbrain.core.untrusted.bounded_file import FileRefusal, read_regular_file
from dualbrain.core.untrusted.bounded_process import ProcessFailure, run_bounded
from dualbrain.errors import ConfigurationError
from dualbrain.robots.optional_imports import import_optional

MAX_DESCRIPTION_BYTES = 32 * 2**20
"""Bytes of a description file."""


def read_bounded(path: Path, max_bytes: int = MAX_DESCRIPTION_BYTES) -> bytes:
    """The content of the regular file `path`, of at most `max_bytes` bytes.

    Raises:
        ConfigurationError: The file does not exist or is larger.
    """
    data = read_regular_file(path, max_bytes)
    if not isinstance(data, FileRefusal):
        return data
    if data.kind == "missing":
        raise ConfigurationError.stating(f"The file {path} does not exist.", fix="Check the path.")
    if data.kind == "too large":
        raise ConfigurationError(
            f"size of {path.name}", got=f"more than {max_bytes} bytes", allowed=f"at most {max_bytes}"
        )
    raise ConfigurationError.stating(data.sentence, fix=data.fix)


def require_size(path: Path, max_bytes: int) -> None:
    """Raise `ConfigurationError` unless `path` is a regular file of at most `max_bytes` bytes, which is not read."""
    data = read_regular_file(path, 0)
    if isinstance(data, FileRefusal) and (data.kind != "too large" or path.stat().st_size > max_bytes):
        read_bounded(path, 0 if data.kind != "too large" else max_bytes)


def root_tag(path: Path) -> str:
    """The name of the root element of the file `path`, which a bounded process reads; raises as `read_xml` does."""
    found = run_bounded("dualbrain.robots.assets.safe_xml:encode_root_tag", _named(path.name, read_bounded(path)))
    if isinstance(found, ProcessFailure):
        raise ConfigurationError.stating(f"The description {path.name} {found.reason}.", fix="Reduce its size.")
    return found.decode()


def encode_root_tag(argument: bytes) -> bytes:
    """The name of the root element of an encoded pair of file name and content, for `root_tag`."""
    name, data = msgspec.msgpack.decode(argument, type=tuple[str, bytes])
    return str(parse_xml(data, name).tag).encode()


def _named(name: str, data: bytes) -> bytes:
    return msgspec.msgpack.encode((name, data))


def read_xml(path: Path) -> Any:
    """The root element of the file `path`; every element carries its line (`sourceline`).

    Raises:
        ConfigurationError: The file is not well-formed (with line and column), or declares a document type.
        MissingDependencyError: lxml is not installed.
    """
    return parse_xml(read_bounded(path), path.name)


def parse_xml(data: bytes, name: str) -> Any:
    """The root element of `data`, read from the file called `name`; raises as `read_xml` does."""
    if (found := data.find(b"<!DOCTYPE")) >= 0:
        raise _doctype_error(name, data[found : found + 80].decode(errors="replace"))
    etree = import_optional("lxml.etree")
    parser = _make_parser(etree, recover=False)
    try:
        root = etree.fromstring(data, parser)
    except etree.XMLSyntaxError:
        _check_only_undeclared_prefixes(etree, parser.error_log, name)
        _check_without_namespaces(data, name)
        root = etree.fromstring(data, _make_parser(etree, recover=True))
        _bind_undeclared_prefixes(root)
    if root.getroottree().docinfo.doctype:  # the encoding of the file hid it from the search in the bytes
        raise _doctype_error(name, root.getroottree().docinfo.doctype[:80])
    return root


def undeclared_namespace(prefix: str) -> str:
    """The namespace of names that were written with `prefix` although the file declares no such prefix."""
    return f"undeclared:{quote(prefix)}"


def _make_parser(etree: Any, *, recover: bool) -> Any:
    return etree.XMLParser(
        resolve_entities=False,
        no_network=True,
        load_dtd=False,
        dtd_validation=False,
        huge_tree=False,
        recover=recover,
    )


def _check_only_undeclared_prefixes(etree: Any, errors: Any, name: str) -> None:
    """Raise the first of `errors` that is not about an undeclared namespace prefix."""
    for error in errors:
        if error.type != etree.ErrorTypes.NS_ERR_UNDEFINED_NAMESPACE:
            raise _syntax_error(name, error.line, error.column, error.message)


def _check_without_namespaces(data: bytes, name: str) -> None:
    """Raise unless `data` is well-formed apart from namespaces, and without a document type.

    libxml2 overlooks some errors (duplicate attributes, content after the root) once it has met an undeclared prefix.
    """

    def refuse_doctype(root: str, *_: object) -> NoReturn:
        raise _doctype_error(name, f"<!DOCTYPE {root[:60]}")

    parser = expat.ParserCreate()
    parser.StartDoctypeDeclHandler = refuse_doctype
    try:
        parser.Parse(data, True)
    except expat.ExpatError as error:
        raise _syntax_error(name, error.lineno, error.offset + 1, expat.ErrorString(error.code)) from error
    except (ValueError, LookupError) as error:  # an encoding that expat cannot read
        raise _syntax_error(name, 1, 1, str(error)) from error


def _bind_undeclared_prefixes(root: Any) -> None:
    """Move every element and attribute with an undeclared prefix into the namespace of that prefix."""
    for element in root.iter("*"):
        if _has_undeclared_prefix(element.tag):
            element.tag = _bound_name(element.tag)
        for key in filter(_has_undeclared_prefix, element.attrib.keys()):
            element.set(_bound_name(key), element.attrib.pop(key))


def _has_undeclared_prefix(name: str) -> bool:
    """Whether the lxml name `name` still contains its prefix: bound names are written `{namespace}name`."""
    return ":" in name and not name.startswith("{")


def _bound_name(name: str) -> str:
    prefix, _, local = name.partition(":")
    return f"{{{undeclared_namespace(prefix)}}}{local}"


def _syntax_error(name: str, line: int, column: int, got: str) -> ConfigurationError:
    return ConfigurationError(f"{name}, line {line}, column {column}", got=got, allowed="well-formed XML")


def _doctype_error(name: str, got: str) -> ConfigurationError:
    return ConfigurationError(
        f"document type of {name}",
        got=got,
        allowed="none: a description needs no entities, and they can expand without bound or read other files",
        fix="Remove the <!DOCTYPE …>.",
    )
