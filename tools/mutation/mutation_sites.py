"""Where a source can be changed, by kind of mistake. A site is a span of characters and its possible replacements."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator

from tools.mutation.tokens import (
    TYPES,
    Token,
    closing_bracket,
    in_loop_head,
    is_binary,
    is_cast,
    opening_bracket,
    statement_start,
)

Site = tuple[int, int, tuple[str, ...]]
"""Start, end, replacements."""

FACTORS = ("0.001", "57.3", "2.0", "0.5")
COMPARISON_SWAPS = {"<": ">", ">": "<", "<=": ">=", ">=": "<=", "==": "!=", "!=": "==", "&&": "||", "||": "&&"}
TERM_ENDS = frozenset(
    [
        "+",
        "-",
        ";",
        ",",
        ")",
        "]",
        "}",
        "?",
        ":",
        "<",
        ">",
        "<=",
        ">=",
        "==",
        "!=",
        "&&",
        "||",
        "&",
        "|",
        "=",
        "if",
        "else",
        "for",
        "and",
        "or",
    ]
)
PAIRS = (
    ("min", "max"),
    ("dbk_min", "dbk_max"),
    ("lower", "upper"),
    ("low", "high"),
    ("q_lower", "q_upper"),
    ("proximal", "distal"),
    ("now", "next"),
    ("first_joint", "end_joint"),
    ("DBK_ROW_LOWER", "DBK_ROW_UPPER"),
    ("sine", "cosine"),
)
SWAPS = {a: b for pair in PAIRS for a, b in (pair, pair[::-1])}
ANNOTATION_NAMES = frozenset(
    ["list", "dict", "tuple", "set", "Sequence", "Mapping", "float", "int", "str", "Any", "Array", "Literal"]
)
NOT_QUANTITIES = frozenset(("n", "name", "group", "frame", "link", "real", "shape"))


def sign(source: str, words: list[Token]) -> Iterator[Site]:
    """Plus for minus, and a minus that is forgotten."""
    other = {"+": "-", "-": "+", "+=": "-=", "-=": "+="}
    for i, word in enumerate(words):
        if word.text in ("+=", "-=") or (word.text in ("+", "-") and is_binary(words, i)):
            yield word.start, word.end, (other[word.text],)
        elif word.text == "-" and i + 1 < len(words):
            yield word.start, word.end, ("",)


def index(source: str, words: list[Token]) -> Iterator[Site]:
    """The neighbour's element, or always the first."""
    for i, word in enumerate(words):
        if word.text != "[" or i == 0 or not (words[i - 1].kind == "name" or words[i - 1].text in ("]", ")")):
            continue
        end = closing_bracket(words, i)
        inside = source[word.end : words[end].start]
        if inside in ANNOTATION_NAMES or words[i - 1].text in ANNOTATION_NAMES:
            continue
        declared = i >= 2 and (words[i - 2].text in TYPES or (words[i - 2].text == "*" and not is_binary(words, i - 2)))
        if (
            declared
            or inside.isupper()
            or not inside.strip()
            or ":" in inside
            or '"' in inside
            or words[i - 1].text in TYPES
        ):
            continue
        if inside.isdigit():
            yield word.end, words[end].start, (str(int(inside) - 1) if int(inside) else "1",)
        else:
            yield word.end, words[end].start, (f"{inside} + 1", *(("0",) if inside.isidentifier() else ()))


def unit(source: str, words: list[Token]) -> Iterator[Site]:
    """A length, time or angle in the wrong unit, or half or twice of it."""
    python = any(word.text == "def" for word in words)
    yield from (_python_attributes if python else _c_assignments)(source, words)


def _c_assignments(source: str, words: list[Token]) -> Iterator[Site]:
    whole = set(re.findall(r"\bint(?:32|16)_t \*?(\w+)", source)) | {"count", "flags", "status", "ready", "moving"}
    for i, word in enumerate(words):
        if word.text not in ("=", "+=", "-=") or in_loop_head(words, i):
            continue
        first = statement_start(words, i)
        before = {w.text for w in words[first:i]}
        if before & {"int32_t", "int16_t", "enum", "*"} or before & whole or words[i + 1].text in ("{", "&"):
            continue
        end = _expression_end(words, i + 1)
        text = source[words[i + 1].start : words[end].start]
        yield words[i + 1].start, words[end].start, tuple(f"(dbk_real){f} * ({text})" for f in FACTORS)
    for i in range(len(words) - 3):
        a, arrow, field, after = (w.text for w in words[i : i + 4])
        if a == "model" and arrow == "->" and after != "[" and not re.match(r"n$|n_", field):
            site = (words[i].start, words[i + 2].end)
            yield (*site, tuple(f"((dbk_real){f} * {source[slice(*site)]})" for f in FACTORS))


def _expression_end(words: list[Token], at: int) -> int:
    while at < len(words) and words[at].text not in (";", ",", ")", "}"):
        at = closing_bracket(words, at) + 1 if words[at].text in ("(", "[", "{") else at + 1
    return at


def _python_attributes(source: str, words: list[Token]) -> Iterator[Site]:
    for i in range(2, len(words) - 1):
        if words[i - 1].text != "." or words[i].kind != "name" or words[i + 1].text in ("(", ".", "["):
            continue
        first = i
        while first >= 2 and words[first - 1].text == "." and words[first - 2].kind == "name":
            first -= 2
        named = words[i].text in NOT_QUANTITIES or words[i].text.endswith("s") or words[i + 1].text == "="
        if (
            named
            or words[first - 1].text in ("if", "in", "import", "from", "is", "case")
            or words[first].text in ("np", "_kernel")
        ):
            continue
        text = source[words[first].start : words[i].end]
        yield words[first].start, words[i].end, tuple(f"{f} * {text}" for f in FACTORS)


def comparison(source: str, words: list[Token]) -> Iterator[Site]:
    """The other way round; in the head of a loop one turn more; a negation that is forgotten."""
    for i, word in enumerate(words):
        if word.text in COMPARISON_SWAPS and is_binary(words, i):
            more = {"<": "<=", ">=": ">"} if in_loop_head(words, i) else COMPARISON_SWAPS
            yield word.start, word.end, (more.get(word.text, COMPARISON_SWAPS[word.text]),)
        elif word.text == "!" and words[i + 1].text != "=":
            yield word.start, word.end, ("",)


def constant(source: str, words: list[Token]) -> Iterator[Site]:
    """Another number."""
    for i, word in enumerate(words):
        around = {words[i - 1].text if i else "", words[i + 1].text if i + 1 < len(words) else ""}
        if word.kind != "number" or around in ({"{", "}"}, {"[", "]"}):
            continue
        digits = word.text.rstrip("fFuUlL")
        value = float(int(digits, 0)) if digits.isalnum() and "e" not in digits.lower() else float(digits)
        tail = word.text[len(digits) :]
        whole = digits.isdigit()
        choices = (1.0,) if value == 0 else ((0.0, 2.0) if value == 1 else (0.5 * value, 2.0 * value))
        yield word.start, word.end, tuple((str(int(c)) if whole else repr(c)) + tail for c in choices)


def dropped_term(source: str, words: list[Token]) -> Iterator[Site]:
    """A term or factor that is forgotten; a line that adds to something and is forgotten."""
    for i, word in enumerate(words):
        if word.text in ("+", "-", "*", "/", "&", "|") and is_binary(words, i):
            ends = TERM_ENDS | ({"*", "/"} if word.text in "*/" else set())
            end = i + 1
            while (
                end < len(words)
                and (words[end].text not in ends or not is_binary(words, end))
                and words[end].text not in ";,)]}?:"
            ):
                end = closing_bracket(words, end) + 1 if words[end].text in ("(", "[") else end + 1
            start = words[i - 1].end
            if end < len(words) and end > i + 1:
                yield start, words[end - 1].end, ("",)
        elif word.text in ("+=", "-=", "&=", "|="):
            end = _expression_end(words, i + 1)
            if words[end].text == ";" and not in_loop_head(words, i):
                left = i - 1
                while words[left].text in ("]", ")"):
                    left = opening_bracket(words, left) - 1
                while left >= 2 and words[left - 1].text in ("->", "."):
                    left -= 2
                yield words[left].start, words[end].start, ("",)


def swap(source: str, words: list[Token]) -> Iterator[Site]:
    """Swap min and max, lower and upper, and other pairs that are easily confused."""
    for i, word in enumerate(words):
        last = words[i - 1].text if i else ""
        called = i + 1 < len(words) and words[i + 1].text == "(" and not word.text.endswith(("min", "max"))
        if (
            word.text in SWAPS
            and not called
            and last not in TYPES | {"def", "import"}
            and not _is_star_of_declaration(words, i - 1)
        ):
            yield word.start, word.end, (SWAPS[word.text],)


def _is_star_of_declaration(words: list[Token], at: int) -> bool:
    return words[at].text == "*" and not is_binary(words, at)


KINDS: dict[str, Callable[[str, list[Token]], Iterator[Site]]] = {
    "sign": sign,
    "index": index,
    "unit": unit,
    "comparison": comparison,
    "constant": constant,
    "dropped": dropped_term,
    "swap": swap,
}

__all__ = ["KINDS", "Site", "is_cast"]
