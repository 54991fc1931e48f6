"""The worst call path: how much stack a step can need, and that nothing recurses."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class CallPath:
    """Functions from the outermost inward, and the bytes of all their frames."""

    functions: tuple[str, ...]
    stack: int


def cycles(calls: Mapping[str, set[str]]) -> list[tuple[str, ...]]:
    """Call paths that come back to where they were; none means no recursion."""
    found: list[tuple[str, ...]] = []
    settled: set[str] = set()

    def visit(name: str, above: tuple[str, ...]) -> None:
        if name in above:
            found.append((*above[above.index(name) :], name))
        elif name not in settled:
            for callee in sorted(calls.get(name, ())):
                visit(callee, (*above, name))
            settled.add(name)

    for name in sorted(calls):
        visit(name, ())
    return found


def deepest_call_path(start: str, calls: Mapping[str, set[str]], stack: Mapping[str, int]) -> CallPath:
    """The call path from `start` with the most stack; functions without a frame of ours (memcpy) count as 0."""
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
