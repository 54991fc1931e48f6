"""What each step from one method to another does, at the places that both flew."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import fields
from math import nan

from dualbrain.evaluation.analysis.hypotheses import paired
from dualbrain.evaluation.analysis.metrics import BY_NAME
from dualbrain.evaluation.analysis.statistics import Compared, compare, difference, holm
from dualbrain.evaluation.protocol.method import Method, find_method
from dualbrain.evaluation.report.tables import Grid, methods_of, number
from dualbrain.evaluation.results.episode_row import Row

TOLD = ("violation rate", "success", "free one-shot compliance", "Δ of successes", "intervention frequency, on task",
        "time to completion")  # fmt: skip
STEPS = (
    ("B1", "B2"), ("B2", "G"), ("G", "B3"), ("B3", "B4"), ("B4", "M"), ("B3", "PE"), ("B3", "P"), ("PE", "P"),
    ("M", "Full"), ("P", "Full"), ("A1", "A2"), ("A1", "A3"), ("A2", "A3"),
)  # fmt: skip
"""Declared, and no others: each comparison more makes the correction of all larger."""
WORDS = ("name", "says")
"""Fields of a method that switch nothing."""


def switches(a: Method, b: Method) -> tuple[str, ...]:
    """The switches in which two methods differ."""
    return tuple(
        one.name for one in fields(a) if one.name not in WORDS and getattr(a, one.name) != getattr(b, one.name)
    )


def pairs(names: Sequence[str]) -> Iterator[tuple[str, str, str]]:
    """(switches, method, method) of what is asked: each arm beside that from which it came.

    The arms of the main table in their steps, and of `X-…` what became of X by it.
    """
    asked = [*STEPS, *((name.partition("-")[0], name) for name in names if "-" in name)]
    for a, b in asked:
        if a in names and b in names:
            yield ", ".join(switches(find_method(a), find_method(b))), a, b


def contrasts(rows: Sequence[Row]) -> Grid:
    """Each pair and metric that both have: the second minus the first, its interval, p corrected over the table.

    What is the same in every cluster could not have been found to differ, and is not counted (Tarone 1990).
    """
    told: list[tuple[str, str, str, str, Compared]] = []
    for switch, a, b in pairs(methods_of(rows)):
        for name in TOLD:
            found = compare(*paired(rows, b, a, BY_NAME[name].of), difference)
            if found.clusters > 1:
                told.append((switch, a, b, name, found))
    corrected = holm([nan if found.alike else found.p for *_, found in told])
    lines = [
        (switch, f"{b} − {a}", name, number(found.effect, unit),
         "all alike" if found.alike else f"[{number(found.low, unit)}, {number(found.high, unit)}]",
         number(p), number(found.dz), str(found.clusters))
        for (switch, a, b, name, found), p in zip(told, corrected, strict=True)
        for unit in [BY_NAME[name].unit]
    ]  # fmt: skip
    head = ("switches", "methods", "metric", "difference", "95 %", "p (Holm)", "d_z", "clusters")
    return Grid(
        "From one method to another", head, tuple(lines), "at the places of both; no pair but these was looked at"
    )
