"""Parser of TOML from untrusted files: bounded nesting and bounded numbers, and every fault is a value.

`tomllib` alone answers deep nesting with `RecursionError`, a long integer with a `ValueError` about its digits, and
needs time that grows with the square of the parts of a key. Nesting, parts and digits are therefore counted before it
runs, in one pass over the text.
"""

from __future__ import annotations

import re
import tomllib
from dataclasses import dataclass
from typing import Any

MAX_DEPTH = 16
"""Largest nesting of arrays and inline tables."""
MAX_KEY_PARTS = 16
"""Largest number of dots between two delimiters: the parts of a key."""
MAX_DIGITS = 64
"""Largest number of digits in a row outside strings."""

_SPECIAL = re.compile(rf"[\"'#\[\]{{}}.=,\n]|[0-9A-Fa-f_]{{{MAX_DIGITS + 1}}}")
_BASIC_END = re.compile(r'(?:[^"\\\n]|\\.)*+"')
_MULTILINE_BASIC_END = re.compile(r'(?:[^"\\]|\\.|"(?!""))*+"{3,5}', re.DOTALL)
_LITERAL_END = re.compile(r"[^'\n]*+'")
_MULTILINE_LITERAL_END = re.compile(r"(?:[^']|'(?!''))*+'{3,5}")
_MATCH_STRING_END = {
    '"': _BASIC_END.match,
    '"""': _MULTILINE_BASIC_END.match,
    "'": _LITERAL_END.match,
    "'''": _MULTILINE_LITERAL_END.match,
}
_LOCATION = re.compile(r"line (\d+), column (\d+)")


@dataclass(frozen=True, slots=True)
class TomlFault:
    """Why a text is not a usable TOML document, with line and column (from 1)."""

    problem: str
    line: int
    column: int


def parse_toml(data: bytes | str) -> dict[str, Any] | TomlFault:
    """The tables of the TOML document `data` (UTF-8), or its first fault; never raises."""
    try:
        text = data if isinstance(data, str) else data.decode("utf-8")
    except UnicodeDecodeError as error:
        return TomlFault(f"not UTF-8: {error}", 1, 1)
    if (fault := _find_excess(text)) is not None:
        return fault
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        return TomlFault(str(error), *_location_of(str(error), text))
    except (ValueError, RecursionError) as error:
        return TomlFault(str(error) or type(error).__name__, 1, 1)


def _find_excess(text: str) -> TomlFault | None:
    """The first place that is nested too deeply or has too many key parts or digits; the time is linear."""
    depth = parts = position = 0
    while (found := _SPECIAL.search(text, position)) is not None:
        mark, position = found.group(), found.end()
        if mark in "\"'":
            quotes = mark * 3 if text.startswith(mark * 3, found.start()) else mark
            end = _MATCH_STRING_END[quotes](text, found.start() + len(quotes))
            if end is None:
                return None  # not closed: the parser names the place
            position = end.end()
        elif mark == "#":
            position = text.find("\n", position)
            if position < 0:
                return None
        elif mark == ".":
            parts += 1
            if parts >= MAX_KEY_PARTS:
                return _fault_at(text, found.start(), f"a key of more than {MAX_KEY_PARTS} parts")
        elif len(mark) > MAX_DIGITS:
            return _fault_at(text, found.start(), f"a number or name of more than {MAX_DIGITS} digits")
        else:
            parts = 0
            depth += (mark in "[{") - (mark in "]}")
            if depth > MAX_DEPTH:
                return _fault_at(text, found.start(), f"brackets nested more than {MAX_DEPTH} deep")
    return None


def _fault_at(text: str, position: int, problem: str) -> TomlFault:
    line_start = text.rfind("\n", 0, position) + 1
    return TomlFault(problem, text.count("\n", 0, position) + 1, position - line_start + 1)


def _location_of(message: str, text: str) -> tuple[int, int]:
    """Line and column in the message of tomllib; the last line for an error at the end of the document."""
    if found := _LOCATION.search(message):
        return int(found.group(1)), int(found.group(2))
    return max(1, len(text.splitlines())), 1
