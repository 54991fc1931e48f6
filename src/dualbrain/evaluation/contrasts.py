"""What one switch does: methods that differ in it alone, compared at the places that both flew."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import fields
from itertools import combinations

from dualbrain.evaluation.grids import Grid, methods_of, number
from dualbrain.evaluation.hypotheses import paired
from dualbrain.evaluation.method import Method, find_method
from dualbrain.evaluation.metrics import BY_NAME
from dualbrain.evaluation.row import Row
from dualbrain.evaluation.statistics import Compared, compare, difference, holm

TOLD = ("violation rate", "success", "free one-shot compliance", "Δ of successes", "intervention frequency, on task",
        "time to completion")  # fmt: skip
WORDS = ("name", "says")
"""Fields of a method that switch nothing."""


def switches(a: Method, b: Method) -> tuple[str, ...]:
    """The switches in which two methods differ."""
    return tuple(
        one.name for one in fields(a) if one.name not in WORDS and getattr(a, one.name) != getattr(b, one.name)
    )


def pairs(names: Sequence[str]) -> Iterator[tuple[str, str, str]]:
    """(switch, method, method) of all that differ in one switch alone, in the order of `names`."""
    for a, b in combinations(names, 2):
        differing = switches(find_method(a), find_method(b))
        if len(differing) == 1:
            yield differing[0], a, b


def contrasts(rows: Sequence[Row]) -> Grid:
    """Each pair and metric that both have: the second minus the first, its interval, p corrected over the table."""
    told: list[tuple[str, str, str, str, Compared]] = []
    for switch, a, b in pairs(methods_of(rows)):
        for name in TOLD:
            found = compare(*paired(rows, b, a, BY_NAME[name].of), difference)
            if found.clusters > 1:
                told.append((switch, a, b, name, found))
    corrected = holm([found.p for *_, found in told])
    lines = [
        (switch, f"{b} − {a}", name, number(found.effect, unit),
         f"[{number(found.low, unit)}, {number(found.high, unit)}]", number(p), number(found.dz), str(found.clusters))
        for (switch, a, b, name, found), p in zip(told, corrected, strict=True)
        for unit in [BY_NAME[name].unit]
    ]  # fmt: skip
    head = ("switch", "methods", "metric", "difference", "95 %", "p (Holm)", "d_z", "clusters")
    return Grid("What one switch does", head, tuple(lines), "methods that differ in one thing, at the places of both")
