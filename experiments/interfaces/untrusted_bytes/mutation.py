"""One bad value, by kind, in an otherwise valid text or msgpack value."""

from __future__ import annotations

import bz2
import gzip
import io
import re
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np

VALID = "valid"
"""The control: nothing is changed."""
NUMERIC_KINDS = ("nan", "infinite", "denormal", "negative", "huge")
VALUE_KINDS = (*NUMERIC_KINDS, "empty", "wrong type", "wrong shape", "deep", "long", "unicode")
"""Kinds that replace one value; a kind of `NUMERIC_KINDS` replaces a number."""
BYTE_KINDS = ("truncated", "compressed", "no bytes")
"""Kinds that change all bytes."""
KINDS = (*VALUE_KINDS, *BYTE_KINDS)
HIDDEN_TEXTS = ("\u202e\u2066", "a\u200bb", "\x00", "\x1b[2J", "\ufeff", "\U000e0041", "\ufdd0", "\u115f", "\u00ad")
"""Hidden characters of several classes: direction, zero width, control, tag, noncharacter, filler, soft hyphen."""
DEPTHS, LENGTHS = (20, 600, 30_000), (2_000, 100_000)


@dataclass(frozen=True, slots=True)
class Syntax:
    """How values are found and written in a text format.

    `values` finds a value (group 1, if it has one), `skipped` what is no value although it looks like one; `written`
    maps a kind to texts in place of a value. Without an entry for a kind its texts are those of JSON.
    """

    values: re.Pattern[str]
    is_number: Callable[[str], bool]
    written: dict[str, tuple[str, ...]]


NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")


def _is_number(text: str) -> bool:
    return NUMBER.fullmatch(text.strip()) is not None


_JSON_WRITTEN = {
    "nan": ("NaN", '"NaN"', "-NaN", "null"),
    "infinite": ("Infinity", "-Infinity", "1e999", "-1e999"),
    "denormal": ("5e-324", "1e-310", "-1e-400"),
    "huge": ("1e300", "-1e300", "1" + "0" * 400, "1e308", "9" * 30),
    "empty": ('""', "[]", "{}", ""),
    "wrong type": ("true", "null", '"0.1"', "0.1", "{}", '{"a": 1}', "b'1'", "7"),
    "wrong shape": ("[0.1]", "[0.1, 0.2]", "[[0.1, 0.2, 0.3]]", "[0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8]"),
    "deep": (*("[" * depth + "]" * depth for depth in DEPTHS), '{"a":' * 600 + "1" + "}" * 600),
    "long": tuple('"' + "x" * length + '"' for length in LENGTHS) + tuple("[" + "0," * n + "0]" for n in LENGTHS),
    "unicode": (*(f'"{text}"' for text in HIDDEN_TEXTS), '"\\ud800"', '"\\u0000"', "\u0661", "\uff11"),
}
JSON = Syntax(
    re.compile(r'("(?:[^"\\]|\\.)*"(?!\s*:)|-?\d+(?:\.\d+)?(?:[eE][+-]?\d+)?|true|false|null)(?=\s*[,\]}])'),
    _is_number,
    _JSON_WRITTEN,
)
TOML = Syntax(
    re.compile(r'(?:(?<==)|(?<=[\[,]))\s*("[^"\n]*"|[+-]?\d[\d.eE+-]*|true|false)\s*(?=[,\]\n])'),
    _is_number,
    _JSON_WRITTEN
    | {
        "nan": ("nan", "+nan", "-nan"),
        "infinite": ("inf", "-inf", "1e999"),
        "wrong type": ("true", '"0.1"', "0.1", "{a = 1}", "1979-05-27", "0x1", "7"),
        "empty": ('""', "[]", "{}", ""),
    },
)
XML = Syntax(
    re.compile(r"='([^']*)'"),
    lambda text: bool(text.split()) and all(map(_is_number, text.split())),
    {
        "nan": ("nan", "NaN", "0 nan 0", "nan nan nan"),
        "infinite": ("inf", "-inf", "1e999", "0 inf 0"),
        "denormal": ("5e-324", "1e-310"),
        "huge": ("1e300", "-1e300", "1" + "0" * 400),
        "empty": ("", " "),
        "wrong type": ("x", "0.1m", "true", "0x1", "1_0", "1,0"),
        "wrong shape": ("0 0", "0 0 0 0 0 0 0", "0 " * 1000),
        "deep": tuple("'/>" + "<a>" * depth + "<a b='" for depth in DEPTHS),
        "long": tuple("x" * length for length in LENGTHS) + tuple("0 " * length for length in LENGTHS),
        "unicode": (*(text for text in HIDDEN_TEXTS), "&#x202e;", "&#0;", "\u0661"),
    },
)
PLAIN = Syntax(
    re.compile(r"([\w.+-]+)"),
    _is_number,
    {
        **{kind: tuple(one.strip('"') for one in texts) for kind, texts in _JSON_WRITTEN.items()},
        "deep": tuple(mark * depth for depth in DEPTHS for mark in ("> ", "[", "<div>", "* ", "(")),
        "unicode": HIDDEN_TEXTS,
        "long": (*("word " * length for length in LENGTHS), "x" * 100_000),
    },
)


def mutate_text(kind: str, data: bytes, syntax: Syntax, rng: np.random.Generator) -> bytes | None:
    """`data` with one bad value of `kind`; None if it contains no such value."""
    if kind not in VALUE_KINDS:
        return mutate_bytes(kind, data, rng)
    text = data.decode()
    found = [match.span(1) for match in syntax.values.finditer(text)]
    if kind in NUMERIC_KINDS:
        found = [(start, end) for start, end in found if syntax.is_number(text[start:end])]
    if not found:
        return None
    start, end = found[int(rng.integers(len(found)))]
    if kind == "negative":
        new = "-" + text[start:end].strip().lstrip("+-")
    else:
        choices = syntax.written[kind]
        if kind == "wrong type" and syntax.is_number(text[start:end]):
            choices = tuple(one for one in choices if not syntax.is_number(one))
        new = choices[int(rng.integers(len(choices)))]
    return (text[:start] + new + text[end:]).encode("utf-8", "surrogatepass")


def mutate_bytes(kind: str, data: bytes, rng: np.random.Generator) -> bytes:
    """All bytes, shortened or compressed."""
    match kind:
        case "truncated":
            return data[: int(rng.integers(1, len(data.rstrip())))]  # without white space alone at the end
        case "compressed":
            return _COMPRESSED[int(rng.integers(len(_COMPRESSED)))](data)
        case "no bytes":
            return b""
        case _:
            return data


def _zip(data: bytes) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("data", data)
    return buffer.getvalue()


_COMPRESSED: tuple[Callable[[bytes], bytes], ...] = (gzip.compress, zlib.compress, bz2.compress, _zip)


# --- msgpack --------------------------------------------------------------------------------------------------------


def mutate_value(kind: str, value: Any, rng: np.random.Generator) -> Any:
    """A copy of `value` (arrays, maps and scalars) with one bad value of `kind`; None if there is none to replace."""
    paths = [path for path, leaf in _leaves(value) if kind not in NUMERIC_KINDS or _is_real(leaf)]
    if not paths:
        return None
    path = paths[int(rng.integers(len(paths)))]
    return _replaced(value, path, lambda old: _bad_leaf(kind, old, rng))


def _is_real(leaf: Any) -> bool:
    return isinstance(leaf, (int, float)) and not isinstance(leaf, bool)


def _leaves(value: Any, path: tuple[Any, ...] = ()) -> list[tuple[tuple[Any, ...], Any]]:
    parts: Any = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else None
    if not parts:
        return [(path, value)]
    return [leaf for key, part in parts for leaf in _leaves(part, (*path, key))]


def _replaced(value: Any, path: tuple[Any, ...], change: Callable[[Any], Any]) -> Any:
    if not path:
        return change(value)
    copy = dict(value) if isinstance(value, dict) else list(value)
    copy[path[0]] = _replaced(value[path[0]], path[1:], change)
    return copy


def _bad_leaf(kind: str, old: Any, rng: np.random.Generator) -> Any:
    if kind == "negative":
        return -abs(old) or -1
    choices = _BAD_LEAVES[kind]
    return choices[int(rng.integers(len(choices)))]


_BAD_LEAVES: dict[str, tuple[Any, ...]] = {
    "nan": (float("nan"),),
    "infinite": (float("inf"), float("-inf")),
    "denormal": (5e-324, 1e-310),
    "huge": (1e300, -1e300, 2**63 - 1, -(2**63), 2**64 - 1),
    "empty": ("", [], {}, b""),
    "wrong type": ("0.1", None, True, {"a": 1}, b"1", msgspec.msgpack.Ext(1, b"1")),
    "wrong shape": ([0.1], [0.1, 0.2], [[0.1, 0.2, 0.3]], [0.1] * 70),
    "deep": tuple(msgspec.Raw(b"\x91" * depth + b"\xc0") for depth in DEPTHS),
    "long": tuple("x" * length for length in LENGTHS) + tuple([0.5] * length for length in LENGTHS),
    "unicode": (*HIDDEN_TEXTS, msgspec.Raw(b"\xa3\xed\xa0\x80"), msgspec.Raw(b"\xa1\xff")),
}
