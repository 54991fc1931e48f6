"""The parser accepts exactly one RFC 8259 value; everything else is a rejection at the syntax stage."""

import json
from typing import Any

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dualbrain.contracts.gate.strict_json import MAX_BYTES, MAX_COMMAS, MAX_DEPTH, parse
from dualbrain.contracts.verdict import Rejected

TEXT = st.text(st.characters(exclude_categories=["Cs"]), max_size=12)
VALUES = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(10**15) + 1, 10**15 - 1)
    | st.floats(-1e300, 1e300)
    | TEXT
    | st.text('[]{}"\\,: u', max_size=12),
    lambda inner: (
        st.lists(inner, max_size=5) | st.dictionaries(TEXT | st.text('[]{}"\\', max_size=4), inner, max_size=5)
    ),
    max_leaves=20,
)


def nested(depth: int, opening: str = "[", closing: str = "]") -> bytes:
    """Brackets `depth` deep."""
    return (opening * depth + closing * depth).encode()


@settings(max_examples=200, deadline=None)
@given(VALUES, st.booleans(), st.sampled_from([None, 2]))
def test_parsing_inverts_json_dumps(value: Any, ascii_only: bool, indent: int | None) -> None:
    data = json.dumps(value, ensure_ascii=ascii_only, indent=indent).encode()
    answer = parse(data)
    if isinstance(answer, Rejected):
        assert answer.got == f"deeper than {MAX_DEPTH}"
        assert depth_of(value) > MAX_DEPTH
    else:
        assert answer == value


def depth_of(value: Any) -> int:
    """How deep arrays and objects nest in `value`."""
    inner = value.values() if isinstance(value, dict) else value if isinstance(value, list) else None
    return 0 if inner is None else 1 + max(map(depth_of, inner), default=0)


@settings(max_examples=400, deadline=None)
@given(st.binary(max_size=60) | st.text('[]{}",:\\u0019eE.-+ntrfalsyNI\n ', max_size=60).map(str.encode))
def test_no_bytes_raise_and_an_independent_reader_agrees(data: bytes) -> None:
    answer = parse(data)
    if isinstance(answer, Rejected):
        assert (answer.stage, answer.pointer) == ("syntax", "")
        assert answer.hint
    else:
        assert msgspec.json.decode(data) == answer


@pytest.mark.parametrize(
    ("data", "got"),
    [
        (b"", ""),
        (b" ", ""),
        (b"{} {}", "{}"),
        (b"{}x", "x"),
        (b"```json\n{}\n```", "```json\\n{}\\n```"),
        (b'{"a":1,}', "}"),
        (b"{'a':1}", "'a':1}"),
        (b'{"a":1 /* */}', "/* */}"),
        (b"[01]", "1]"),
        (b"[.5]", ".5]"),
        (b"[+1]", "+1]"),
        (b"[0x10]", "x10]"),
        (b'["\n"]', '\\n"]'),
        (b'["\\x41"]', '\\\\x41"]'),
        (b"[1.]", ".]"),
        (b'{"a":1,"a":1}', "a"),
        (b'{"speed":1,"sp\\u0065ed":2}', "speed"),
        (b'[{"b":{"c":0,"d":0,"c":0}}]', "c"),
        (json.dumps({str(i): 0 for i in range(65)}).encode(), "object of 65"),
        (b"NaN", "NaN"),
        (b"[Infinity]", "Infinity"),
        (b"[-Infinity]", "-Infinity"),
        (b"[1e999]", "1e999"),
        (b"[-1e400]", "-1e400"),
        (b"[1" + b"0" * 15 + b"]", "1" + "0" * 15),
        (b"[0." + b"3" * 50 + b"]", None),
        (b"[1" + b"0" * 5000 + b"]", None),
        (b"[" + b"9" * 400 + b".5]", None),
        (b'["\\ud800"]', "lone surrogate escape"),
        (b'{"\\udc00":1}', "lone surrogate escape"),
        (b'["\\ude00\\ud83d"]', "lone surrogate escape"),
        (b"\xff", "byte 0xff at 0"),
        (b'{"a":"\xc0\xaf"}', "byte 0xc0 at 6"),
        (b'["\xed\xa0\x80"]', "byte 0xed at 2"),
        (b'["\xf4\x90\x80\x80"]', "byte 0xf4 at 2"),
        (b'["\xe2\x82"]', "byte 0xe2 at 2"),
        (b'{"a":1}\x80', "byte 0x80 at 7"),
        (b"\xef\xbb\xbf{}", "\\ufeff{}"),
        ("{}".encode("utf-16"), "byte 0xff at 0"),
        ("{}".encode("utf-32-le"), None),
        (b'{"a":1}\x00', "\\x00"),
        (nested(MAX_DEPTH + 1), f"deeper than {MAX_DEPTH}"),
        (nested(17, '{"a":', "}"), f"deeper than {MAX_DEPTH}"),
        (b"[" * 60000, f"deeper than {MAX_DEPTH}"),
        (b'["\\\\",' + nested(16) + b"]", f"deeper than {MAX_DEPTH}"),
        (b"[" + b" " * MAX_BYTES + b"]", MAX_BYTES + 2),
        (b"\xff" * (MAX_BYTES + 1), MAX_BYTES + 1),
    ],
)
def test_invalid_documents_are_rejected(data: bytes, got: Any) -> None:
    answer = parse(data)
    assert isinstance(answer, Rejected)
    assert answer.stage == "syntax"
    assert got is None or answer.got == got
    assert len(str(answer.got)) < 120


@pytest.mark.parametrize(
    ("data", "value"),
    [
        (nested(MAX_DEPTH), None),
        (b'["' + b"[" * 40 + b'"]', ["[" * 40]),
        (b'["\\"' + b"[" * 40 + b'"]', ['"' + "[" * 40]),
        (b'["\\\\","[[[[[[[[[[[[[[[[[[["]', ["\\", "[" * 19]),
        (b'["\\ud83d\\ude00"]', ["\U0001f600"]),
        (b"[-0]", [0]),
        (b"[999999999999999]", [999999999999999]),
        (b"[1e5]", [100000.0]),
        (b"[1e-999]", [0.0]),
        (b" \t\r\n[1]\n", [1]),
        ('["é"]'.encode(), ["é"]),
        (b'"' + b"x" * (MAX_BYTES - 2) + b'"', None),
    ],
)
def test_documents_at_the_limits_are_accepted(data: bytes, value: Any) -> None:
    answer = parse(data)
    assert not isinstance(answer, Rejected)
    assert value is None or answer == value


def scan(data: bytes) -> tuple[int, int]:
    """Commas outside strings, and the largest depth of brackets, counted byte by byte."""
    inside, escaped, commas, depth, deepest = False, False, 0, 0, 0
    for byte in data:
        if escaped:
            escaped = False
        elif byte == ord("\\"):
            escaped = True
        elif byte == ord('"'):
            inside = not inside
        elif not inside:
            commas += byte == ord(",")
            depth += (byte in b"[{") - (byte in b"]}")
            deepest = max(deepest, depth)
    return commas, deepest


PIECES = st.sampled_from(
    [
        *("[", "]", "{", "}", "{}", "[]", "[{", "}]", "[],[]", "[" * 9, "]" * 9, "{[" * 8, "]}" * 8),
        *('"', '""', '","', '"[["', '"}"', '"\\""', "\\\\", ",", "," * 600, "1"),
    ]
)


@settings(max_examples=600, deadline=None)
@given(st.lists(PIECES, max_size=40).map("".join).map(str.encode))
def test_commas_and_depth_are_those_of_a_scan_of_every_byte(data: bytes) -> None:
    commas, deepest = scan(data)
    refused_for = parse(data)
    text = str(refused_for.got) if isinstance(refused_for, Rejected) else ""
    assert (text == f"{commas} commas") == (commas > MAX_COMMAS)
    if commas <= MAX_COMMAS:
        assert (text == f"deeper than {MAX_DEPTH}") == (deepest > MAX_DEPTH)


@pytest.mark.parametrize("opening", ["[", "{", "[{", "{[", "[[{", "{{["])
@pytest.mark.parametrize("depth", [15, 16, 17, 18, 24, 32, 33, 48])
def test_the_depth_of_mixed_brackets_is_exact(opening: str, depth: int) -> None:
    opened = (opening * depth)[:depth]
    closed = opened[::-1].translate(str.maketrans("[{", "]}"))
    for text in (opened + closed, f"[]{{}}{opened}{closed}", f"{opened}[]{{}}"):
        found = parse(text.encode())
        deepest = scan(text.encode())[1]
        got = found.got if isinstance(found, Rejected) else None
        assert (got == f"deeper than {MAX_DEPTH}") == (deepest > MAX_DEPTH)
