"""Tokens of C and Python, enough to change one of them: comments, strings and includes are left out."""

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
    """One word of a source: what it is ("name", "number" or "operator") and where, in characters."""

    kind: str
    text: str
    start: int
    end: int


def tokenize(source: str, suffix: str) -> list[Token]:
    """The words of `source` in order; `suffix` is the language's, ".c" or ".py"."""
    words = re.compile(
        f"(?P<skip>{SKIP_PATTERNS[suffix]})|(?P<number>{NUMBER})|(?P<name>{NAME})|(?P<operator>{OPERATOR})",
        re.DOTALL | re.MULTILINE,
    )
    found = ((match.lastgroup or "", match) for match in words.finditer(source))
    return [Token(kind, match.group(), *match.span()) for kind, match in found if kind != "skip"]


def closing_bracket(words: list[Token], at: int) -> int:
    """Index of the bracket that closes the one at `at`, or of the last word."""
    depth = 0
    for i in range(at, len(words)):
        depth += (words[i].text in "([{") - (words[i].text in ")]}") if len(words[i].text) == 1 else 0
        if depth == 0:
            return i
    return len(words) - 1


def opening_bracket(words: list[Token], at: int) -> int:
    """Index of the bracket that opens the one at `at`, or 0."""
    depth = 0
    for i in range(at, -1, -1):
        depth += (words[i].text in ")]}") - (words[i].text in "([{") if len(words[i].text) == 1 else 0
        if depth == 0:
            return i
    return 0


def is_cast(words: list[Token], at: int) -> bool:
    """Whether the `)` at `at` closes a cast such as `(dbk_real)`."""
    return words[at].text == ")" and at >= 2 and words[at - 2].text == "(" and words[at - 1].text in TYPES


def is_binary(words: list[Token], at: int) -> bool:
    """Whether the operator at `at` has an operand on its left."""
    if at == 0:
        return False
    last = words[at - 1]
    if last.kind == "number" or last.text == "]":
        return True
    if last.text == ")":
        return not is_cast(words, at - 1)
    return last.kind == "name" and last.text not in TYPES | {"return", "in", "if", "else", "and", "or", "not", "case"}


def statement_start(words: list[Token], at: int) -> int:
    """Index of the first word of the statement that holds the word at `at`."""
    depth = 0
    for i in range(at - 1, -1, -1):
        text = words[i].text
        depth += (text in (")", "]")) - (text in ("(", "["))
        if text in (";", "{", "}") and depth <= 0:
            return i + 1
    return 0


def in_loop_head(words: list[Token], at: int) -> bool:
    """Whether the word stands between the brackets of a `for`."""
    depth = 0
    for i in range(at - 1, -1, -1):
        text = words[i].text
        depth += (text == ")") - (text == "(")
        if depth < 0:
            return i > 0 and words[i - 1].text == "for"
        if text in ("{", "}"):
            return False
    return False
