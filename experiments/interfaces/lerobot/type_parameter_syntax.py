"""Translates the type syntax of Python 3.12 (PEP 695) into that of Python 3.11, by the tokens of a source.

`type X = ...` becomes an assignment; `class C[T](Base)` gets the base `Generic[T]`; `def f[T: Bound](...)` loses its
list. Each parameter becomes a type variable of the module, without its bound, which has no effect at run time.
"""

from __future__ import annotations

import io
import tokenize
from dataclasses import dataclass, field

Token = tokenize.TokenInfo
Place = tuple[int, int]
"""Line, from 1, and column of a source."""
OPENING, CLOSING = "([{", ")]}"
STATEMENT_STARTS = (
    tokenize.NEWLINE,
    tokenize.INDENT,
    tokenize.DEDENT,
    tokenize.NL,
    tokenize.COMMENT,
    tokenize.ENCODING,
)


@dataclass(slots=True)
class _Changes:
    """Replacements of source ranges (start, end, text), and the names of all type parameters."""

    replacements: list[tuple[Place, Place, str]] = field(default_factory=list)
    variables: dict[str, None] = field(default_factory=dict)


def lower_type_parameters(source: str) -> str:
    """The `source` of a module in the syntax of Python 3.11; unchanged if it does not use that of 3.12."""
    tokens = list(tokenize.generate_tokens(io.StringIO(source).readline))
    changes = _Changes()
    for place, token in enumerate(tokens):
        if token.type != tokenize.NAME or not _starts_statement(tokens, place):
            continue
        if token.string == "type" and tokens[place + 1].type == tokenize.NAME and tokens[place + 2].string == "=":
            changes.replacements.append((token.start, tokens[place + 1].start, ""))
        elif token.string in ("class", "def") and tokens[place + 2].string == "[":
            _lower_list(tokens, place, changes)
    if changes.variables:
        names = "".join(f'{name} = _TypeVar("{name}")\n' for name in changes.variables)
        first = _first_import(tokens)
        text = f"from typing import Generic as _Generic, TypeVar as _TypeVar\n\n{names}\n"
        changes.replacements.append((first, first, text))
    return _replaced(source, changes.replacements)


def _starts_statement(tokens: list[Token], place: int) -> bool:
    before = tokens[place - 1] if place else None
    return before is None or before.type in STATEMENT_STARTS or before.string == "async"


def _lower_list(tokens: list[Token], place: int, changes: _Changes) -> None:
    """Remove the type parameters of the class or function at `place`, and give a class the base `Generic`."""
    first, last = place + 2, _matching(tokens, place + 2)
    depth, names, is_next = 0, [], True
    for token in tokens[first + 1 : last]:
        if depth == 0 and token.type == tokenize.NAME and is_next:
            names.append(token.string)
        is_next = token.string == ","
        depth += (token.string in OPENING) - (token.string in CLOSING)
    changes.variables |= dict.fromkeys(names)
    changes.replacements.append((tokens[first].start, tokens[last].end, ""))
    if tokens[place].string == "class":
        base = f"_Generic[{', '.join(names)}]"
        following = tokens[last + 1]
        if following.string != "(":
            changes.replacements.append((following.start, following.start, f"({base})"))
        else:
            separator = "" if tokens[last + 2].string == ")" else ", "
            changes.replacements.append((following.end, following.end, base + separator))


def _matching(tokens: list[Token], opening: int) -> int:
    depth = 0
    for place in range(opening, len(tokens)):
        depth += (tokens[place].string in OPENING) - (tokens[place].string in CLOSING)
        if tokens[place].type == tokenize.OP and depth == 0:
            return place
    raise SyntaxError(f"a bracket in line {tokens[opening].start[0]} is not closed")


def _first_import(tokens: list[Token]) -> Place:
    """The start of the first import that is not from `__future__`."""
    for place, token in enumerate(tokens):
        is_import = token.type == tokenize.NAME and token.string in ("import", "from") and token.start[1] == 0
        if is_import and _starts_statement(tokens, place) and tokens[place + 1].string != "__future__":
            return token.start
    raise SyntaxError("a module with type parameters but without an import")


def _replaced(source: str, replacements: list[tuple[Place, Place, str]]) -> str:
    lines = source.splitlines(keepends=True)
    starts = [0]
    for line in lines:
        starts.append(starts[-1] + len(line))
    for (row, column), (end_row, end_column), text in sorted(replacements, reverse=True):
        source = source[: starts[row - 1] + column] + text + source[starts[end_row - 1] + end_column :]
    return source
