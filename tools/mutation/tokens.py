"""Tokens of C and Python without comments, strings and includes."""

from __future__ import annotations

import re
from dataclasses import dataclass

NUMBER = r"(?:0[xX][0-9a-fA-F]+|(?:\d+\.\d*|\.\d+|\d+)(?:[eE][+-]?\d+)?)[fFuUlL]*"
NAME = r"[A-Za-z_]\w*"
OPERATOR = r"->|\+\+|--|<<|>>|<=|>=|==|!=|&&|\|\||\*\*|//|[-+*/%&|^]=|[^\s\w]"
SKIP_PATTERNS = {
    ".c": r"/\*.*?\*/|//[^\n]*|^[ \t]*#[ \t]*(?!define)\w+[^\n]*|^[ \t]*#[ \t]*define[ \t]+\w+|\"(?:\\.|[^\"\\\n])*\"",
    ".py": r"\"\"\".*?\"\"\"|#[^\n]*|[rbf]?\"(?:\\.|[^\"\\\n])*\"|[rbf]?'(?:\\.|[^'\\\n])*'",
}
TYPES = frozenset(("dbk_real", "int32_t", "int16_t", "int", "void", "const", "restrict", "struct", "char", "double"))


@dataclass(frozen=True, slots=True)
class Token:
    """One token of a source: kind ("name", "number" or "operator"), text and position in characters."""

    kind: str
    text: str
    start: int
    end: int


def tokenize(source: str, suffix: str) -> list[Token]:
    """Return the tokens of `source` in order; `suffix` is ".c" or ".py"."""
    tokens = re.compile(
        f"(?P<skip>{SKIP_PATTERNS[suffix]})|(?P<number>{NUMBER})|(?P<name>{NAME})|(?P<operator>{OPERATOR})",
        re.DOTALL | re.MULTILINE,
    )
    found = ((match.lastgroup or "", match) for match in tokens.finditer(source))
    return [Token(kind, match.group(), *match.span()) for kind, match in found if kind != "skip"]


def closing_bracket(tokens: list[Token], at: int) -> int:
    """Return the index of the bracket that closes the one at `at`, or of the last token."""
    depth = 0
    for i in range(at, len(tokens)):
        depth += (tokens[i].text in "([{") - (tokens[i].text in ")]}") if len(tokens[i].text) == 1 else 0
        if depth == 0:
            return i
    return len(tokens) - 1


def opening_bracket(tokens: list[Token], at: int) -> int:
    """Return the index of the bracket that opens the one at `at`, or 0."""
    depth = 0
    for i in range(at, -1, -1):
        depth += (tokens[i].text in ")]}") - (tokens[i].text in "([{") if len(tokens[i].text) == 1 else 0
        if depth == 0:
            return i
    return 0


def is_cast(tokens: list[Token], at: int) -> bool:
    """Return whether the `)` at `at` closes a cast such as `(dbk_real)`."""
    return tokens[at].text == ")" and at >= 2 and tokens[at - 2].text == "(" and tokens[at - 1].text in TYPES


def is_binary(tokens: list[Token], at: int) -> bool:
    """Return whether the operator at `at` has a left operand."""
    if at == 0:
        return False
    last = tokens[at - 1]
    if last.kind == "number" or last.text == "]":
        return True
    if last.text == ")":
        return not is_cast(tokens, at - 1)
    return last.kind == "name" and last.text not in TYPES | {"return", "in", "if", "else", "and", "or", "not", "case"}


def statement_start(tokens: list[Token], at: int) -> int:
    """Return the index of the first token of the statement that contains the token at `at`."""
    depth = 0
    for i in range(at - 1, -1, -1):
        text = tokens[i].text
        depth += (text in (")", "]")) - (text in ("(", "["))
        if text in (";", "{", "}") and depth <= 0:
            return i + 1
    return 0


def in_loop_head(tokens: list[Token], at: int) -> bool:
    """Return whether the token at `at` is in the head of a `for` loop."""
    depth = 0
    for i in range(at - 1, -1, -1):
        text = tokens[i].text
        depth += (text == ")") - (text == "(")
        if depth < 0:
            return i > 0 and tokens[i - 1].text == "for"
        if text in ("{", "}"):
            return False
    return False
