"""Bounded TOML: agrees with the standard parser on honest documents, and never raises."""

import time
import tomllib

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from dualbrain.core.untrusted.toml_document import MAX_DEPTH, TomlFault, parse_toml

HONEST = """
title = "[[[[[ not nested ]]]]] # no comment"
quoted = 'a.b.c'
many = \"\"\"
[[[[[[[[[[[[[[[[[[[[[[ \\" "" inside
\"\"\"\"
raw = '''
]]] ' '' "
''''
a.b.c = [1, 2.5, { x = 1.0 }] # [[[[[[[[[[[[[[[[[[[[[[[[[
[table."quoted.key"]
hash = 0xdeadbeef
[[array]]
date = 1979-05-27T07:32:00Z
"""


def test_an_honest_document_is_parsed_as_by_the_standard_parser():
    assert parse_toml(HONEST) == tomllib.loads(HONEST)
    assert parse_toml(HONEST.encode()) == tomllib.loads(HONEST)
    assert parse_toml("x = " + "[" * MAX_DEPTH + "]" * MAX_DEPTH) == tomllib.loads("x = " + "[" * 16 + "]" * 16)


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("x = " + "[" * 100_000, "nested"),
        ("x = " + "{a=" * 100_000, "nested"),
        ("x = " + "[" * 17 + "]" * 17, "nested"),
        ("x = " + "9" * 5000, "digits"),
        ("x = 0x" + "f" * 5000, "digits"),
        ("x = 1." + "9" * 5000, "digits"),
        ("a" + ".a" * 200_000 + " = 1", "parts"),
        ("[a" + ".a" * 200_000 + "]", "parts"),
        ("\na = \n", "line 2, column 5"),
        ("x = '''" * 100_000, ""),
        ('x = """\\' * 100_000, ""),
        ("a = 1\na = 2", "overwrite"),
        (b"\xff", "UTF-8"),
    ],
)
def test_a_hostile_document_is_a_fault_in_bounded_time(text, problem):
    start = time.process_time()
    found = parse_toml(text)
    assert isinstance(found, TomlFault)
    assert problem in found.problem
    assert time.process_time() - start < 3.0


def test_a_fault_names_its_place():
    assert parse_toml("a = 1\nb = [[[[[[[[[[[[[[[[[]]]]]]]]]]]]]]]]]") == TomlFault(
        "brackets nested more than 16 deep", 2, 21
    )


@settings(deadline=None)
@given(st.text(alphabet="a=[]{}.\"'\\#\n1_ ,", max_size=60))
@example("a='''''")
def test_no_text_raises_and_short_ones_agree(text):
    found = parse_toml(text)
    try:
        expected = tomllib.loads(text)
    except tomllib.TOMLDecodeError:
        assert isinstance(found, TomlFault)
    else:
        if isinstance(found, TomlFault):
            assert found.problem.startswith(("brackets", "a key", "a number"))
        else:
            assert found == expected
