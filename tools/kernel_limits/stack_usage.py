"""Deepest call path of a step and its stack, and recursion."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class CallPath:
    """Functions of a call path from the outermost to the innermost, and the sum of their frames [bytes]."""

    functions: tuple[str, ...]
    stack: int


def cycles(calls: Mapping[str, set[str]]) -> list[tuple[str, ...]]:
    """Return all call cycles; an empty list means no recursion."""
    found: list[tuple[str, ...]] = []
    visited: set[str] = set()

    def visit(name: str, above: tuple[str, ...]) -> None:
        if name in above:
            found.append((*above[above.index(name) :], name))
        elif name not in visited:
            for callee in sorted(calls.get(name, ())):
                visit(callee, (*above, name))
            visited.add(name)

    for name in sorted(calls):
        visit(name, ())
    return found


def deepest_call_path(start: str, calls: Mapping[str, set[str]], stack: Mapping[str, int]) -> CallPath:
    """Return the call path from `start` with the largest stack; functions without a known frame (memcpy) count as 0."""
    known: dict[str, CallPath] = {}

    def visit(name: str) -> CallPath:
        if name not in known:
            below = max(
                (visit(callee) for callee in sorted(calls.get(name, ()))),
                key=lambda p: p.stack,
                default=CallPath((), 0),
            )
            known[name] = CallPath((name, *below.functions), stack.get(name, 0) + below.stack)
        return known[name]

    return visit(start)
