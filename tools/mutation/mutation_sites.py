"""Mutation sites of a source by kind of fault. A site is a span of characters with its possible replacements."""

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
"""Start and end [characters], and replacements."""

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


def sign(source: str, tokens: list[Token]) -> Iterator[Site]:
    """Yield exchanges of plus and minus, and omissions of a unary minus."""
    other = {"+": "-", "-": "+", "+=": "-=", "-=": "+="}
    for i, token in enumerate(tokens):
        if token.text in ("+=", "-=") or (token.text in ("+", "-") and is_binary(tokens, i)):
            yield token.start, token.end, (other[token.text],)
        elif token.text == "-" and i + 1 < len(tokens):
            yield token.start, token.end, ("",)


def index(source: str, tokens: list[Token]) -> Iterator[Site]:
    """Yield indices of the neighbouring or the first element."""
    for i, token in enumerate(tokens):
        if token.text != "[" or i == 0 or not (tokens[i - 1].kind == "name" or tokens[i - 1].text in ("]", ")")):
            continue
        end = closing_bracket(tokens, i)
        inside = source[token.end : tokens[end].start]
        if inside in ANNOTATION_NAMES or tokens[i - 1].text in ANNOTATION_NAMES:
            continue
        declared = i >= 2 and (
            tokens[i - 2].text in TYPES or (tokens[i - 2].text == "*" and not is_binary(tokens, i - 2))
        )
        if (
            declared
            or inside.isupper()
            or not inside.strip()
            or ":" in inside
            or '"' in inside
            or tokens[i - 1].text in TYPES
        ):
            continue
        if inside.isdigit():
            yield token.end, tokens[end].start, (str(int(inside) - 1) if int(inside) else "1",)
        else:
            yield token.end, tokens[end].start, (f"{inside} + 1", *(("0",) if inside.isidentifier() else ()))


def unit(source: str, tokens: list[Token]) -> Iterator[Site]:
    """Yield quantities in a wrong unit (milli, degrees), halved or doubled."""
    python = any(token.text == "def" for token in tokens)
    yield from (_python_attributes if python else _c_assignments)(source, tokens)


def _c_assignments(source: str, tokens: list[Token]) -> Iterator[Site]:
    whole = set(re.findall(r"\bint(?:32|16)_t \*?(\w+)", source)) | {"count", "flags", "status", "ready", "moving"}
    for i, token in enumerate(tokens):
        if token.text not in ("=", "+=", "-=") or in_loop_head(tokens, i):
            continue
        first = statement_start(tokens, i)
        before = {w.text for w in tokens[first:i]}
        if before & {"int32_t", "int16_t", "enum", "*"} or before & whole or tokens[i + 1].text in ("{", "&"):
            continue
        end = _expression_end(tokens, i + 1)
        text = source[tokens[i + 1].start : tokens[end].start]
        yield tokens[i + 1].start, tokens[end].start, tuple(f"(dbk_real){f} * ({text})" for f in FACTORS)
    for i in range(len(tokens) - 3):
        a, arrow, field, after = (w.text for w in tokens[i : i + 4])
        if a == "model" and arrow == "->" and after != "[" and not re.match(r"n$|n_", field):
            site = (tokens[i].start, tokens[i + 2].end)
            yield (*site, tuple(f"((dbk_real){f} * {source[slice(*site)]})" for f in FACTORS))


def _expression_end(tokens: list[Token], at: int) -> int:
    while at < len(tokens) and tokens[at].text not in (";", ",", ")", "}"):
        at = closing_bracket(tokens, at) + 1 if tokens[at].text in ("(", "[", "{") else at + 1
    return at


def _python_attributes(source: str, tokens: list[Token]) -> Iterator[Site]:
    for i in range(2, len(tokens) - 1):
        if tokens[i - 1].text != "." or tokens[i].kind != "name" or tokens[i + 1].text in ("(", ".", "["):
            continue
        first = i
        while first >= 2 and tokens[first - 1].text == "." and tokens[first - 2].kind == "name":
            first -= 2
        named = tokens[i].text in NOT_QUANTITIES or tokens[i].text.endswith("s") or tokens[i + 1].text == "="
        if (
            named
            or tokens[first - 1].text in ("if", "in", "import", "from", "is", "case")
            or tokens[first].text in ("np", "_kernel")
        ):
            continue
        text = source[tokens[first].start : tokens[i].end]
        yield tokens[first].start, tokens[i].end, tuple(f"{f} * {text}" for f in FACTORS)


def comparison(source: str, tokens: list[Token]) -> Iterator[Site]:
    """Yield reversed comparisons (in the head of a loop: one more iteration), and omissions of a negation."""
    for i, token in enumerate(tokens):
        if token.text in COMPARISON_SWAPS and is_binary(tokens, i):
            more = {"<": "<=", ">=": ">"} if in_loop_head(tokens, i) else COMPARISON_SWAPS
            yield token.start, token.end, (more.get(token.text, COMPARISON_SWAPS[token.text]),)
        elif token.text == "!" and tokens[i + 1].text != "=":
            yield token.start, token.end, ("",)


def constant(source: str, tokens: list[Token]) -> Iterator[Site]:
    """Yield other constants."""
    for i, token in enumerate(tokens):
        around = {tokens[i - 1].text if i else "", tokens[i + 1].text if i + 1 < len(tokens) else ""}
        if token.kind != "number" or around in ({"{", "}"}, {"[", "]"}):
            continue
        digits = token.text.rstrip("fFuUlL")
        value = float(int(digits, 0)) if digits.isalnum() and "e" not in digits.lower() else float(digits)
        tail = token.text[len(digits) :]
        whole = digits.isdigit()
        choices = (1.0,) if value == 0 else ((0.0, 2.0) if value == 1 else (0.5 * value, 2.0 * value))
        yield token.start, token.end, tuple((str(int(c)) if whole else repr(c)) + tail for c in choices)


def dropped_term(source: str, tokens: list[Token]) -> Iterator[Site]:
    """Yield omissions of a term, a factor or an augmented assignment."""
    for i, token in enumerate(tokens):
        if token.text in ("+", "-", "*", "/", "&", "|") and is_binary(tokens, i):
            ends = TERM_ENDS | ({"*", "/"} if token.text in "*/" else set())
            end = i + 1
            while (
                end < len(tokens)
                and (tokens[end].text not in ends or not is_binary(tokens, end))
                and tokens[end].text not in ";,)]}?:"
            ):
                end = closing_bracket(tokens, end) + 1 if tokens[end].text in ("(", "[") else end + 1
            start = tokens[i - 1].end
            if end < len(tokens) and end > i + 1:
                yield start, tokens[end - 1].end, ("",)
        elif token.text in ("+=", "-=", "&=", "|="):
            end = _expression_end(tokens, i + 1)
            if tokens[end].text == ";" and not in_loop_head(tokens, i):
                left = i - 1
                while tokens[left].text in ("]", ")"):
                    left = opening_bracket(tokens, left) - 1
                while left >= 2 and tokens[left - 1].text in ("->", "."):
                    left -= 2
                yield tokens[left].start, tokens[end].start, ("",)


def swap(source: str, tokens: list[Token]) -> Iterator[Site]:
    """Yield exchanges of min and max, lower and upper, and other pairs that are easily confused."""
    for i, token in enumerate(tokens):
        last = tokens[i - 1].text if i else ""
        called = i + 1 < len(tokens) and tokens[i + 1].text == "(" and not token.text.endswith(("min", "max"))
        if (
            token.text in SWAPS
            and not called
            and last not in TYPES | {"def", "import"}
            and not _is_star_of_declaration(tokens, i - 1)
        ):
            yield token.start, token.end, (SWAPS[token.text],)


def _is_star_of_declaration(tokens: list[Token], at: int) -> bool:
    return tokens[at].text == "*" and not is_binary(tokens, at)


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
