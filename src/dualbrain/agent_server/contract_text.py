"""Contracts in MCP messages, as text: the bytes that a client sent are those that the gate checks and executes.

A JSON parser loses the form of a contract before the gate sees it: the last of two equal keys wins, and numbers change
their digits. So the object at `params.arguments.contract` of a call is replaced by a string that holds its text, before
the MCP library parses the message; the tool hands this text to the gate unchanged.
"""

from __future__ import annotations

import codecs
from typing import Any

import msgspec

from dualbrain.errors import DECODE_ERRORS

CONTRACT = "contract"
"""Name of the argument."""
MALFORMED = b"malformed"
"""A line that no JSON parser accepts, in place of a message that is malformed or too long."""
MAX_MESSAGE_BYTES = 4 << 20
"""Longest message [bytes]; a contract has at most 64 KiB."""
_Object = dict[str, msgspec.Raw]
_decode_object = msgspec.json.Decoder(_Object).decode


def is_utf8_text(message: bytes) -> bool:
    """Whether `message` can be JSON in UTF-8: JSON parsers also read UTF-16 and UTF-32, in which no contract is found.

    Every JSON text in these encodings has null bytes or is invalid UTF-8, and JSON in UTF-8 has neither.
    """
    try:
        message.decode("utf-8")
    except UnicodeDecodeError:
        return False
    return b"\x00" not in message and not message.startswith(codecs.BOM_UTF8)


def contract_as_text(message: bytes) -> bytes:
    """`message` with the contract of a call as a string; a message that names no contract is returned as it is.

    A message that is not one JSON object is replaced by `MALFORMED`, which the MCP library answers with an error.
    """
    if f'"{CONTRACT}"'.encode() not in message and b"\\u" not in message:
        return message
    try:
        return _rewritten(message)
    except (*DECODE_ERRORS, UnicodeError):
        return MALFORMED


def _rewritten(message: bytes) -> bytes:
    call = _decode_object(message)
    parameters = _inner(call, "params")
    arguments = _inner(parameters, "arguments")
    contract = bytes(arguments.get(CONTRACT, b'""'))
    if not contract.startswith(b'"'):
        arguments[CONTRACT] = _encoded(contract.decode("utf-8"))
        parameters["arguments"] = _encoded(arguments)
        call["params"] = _encoded(parameters)
    return msgspec.json.encode(call)  # also where nothing changed, so that equal keys have one meaning


def _inner(outer: _Object, name: str) -> _Object:
    """The object at `name`; an empty one if there is none."""
    value = outer.get(name, msgspec.Raw(b"{}"))
    return _decode_object(value) if bytes(value).startswith(b"{") else {}


def _encoded(value: Any) -> msgspec.Raw:
    return msgspec.Raw(msgspec.json.encode(value))
