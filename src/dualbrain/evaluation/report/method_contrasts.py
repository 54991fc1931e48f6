"""What each step from one method to another does, at the places that both flew."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from math import nan

from msgspec.structs import fields

from dualbrain.evaluation.analysis.hypotheses import pair_values
from dualbrain.evaluation.analysis.metrics import METRIC_BY_NAME
from dualbrain.evaluation.analysis.statistics import PairedComparison, compare, difference, holm_correction
from dualbrain.evaluation.protocol.method import Method, find_method
from dualbrain.evaluation.report.tables import Table, format_number, methods_of
from dualbrain.evaluation.results.episode_row import EpisodeRow

CONTRAST_METRICS = (
    "violation rate",
    "success",
    "free one-shot compliance",
    "Δ of successes",
    "intervention frequency, on task",
    "time to completion",
)
DECLARED_PAIRS = (
    ("B1", "B2"),
    ("B2", "G"),
    ("G", "B3"),
    ("B3", "B4"),
    ("B4", "M"),
    ("B3", "PE"),
    ("B3", "P"),
    ("PE", "P"),
    ("M", "Full"),
    ("P", "Full"),
    ("A1", "A2"),
    ("A1", "A3"),
    ("A2", "A3"),
)
"""Declared, and no others: each comparison more makes the correction of all larger."""
NON_SWITCH_FIELDS = ("name", "description")
"""Fields of a method that switch nothing."""


def differing_switches(a: Method, b: Method) -> tuple[str, ...]:
    """The switches in which two methods differ."""
    return tuple(
        one.encode_name
        for one in fields(a)
        if one.name not in NON_SWITCH_FIELDS and getattr(a, one.name) != getattr(b, one.name)
    )


def method_pairs(names: Sequence[str]) -> Iterator[tuple[str, str, str]]:
    """(switches, method, method) of what is asked: each arm beside that from which it came.

    The arms of the main table in their steps, and of `X-…` what became of X by it.
    """
    asked = [*DECLARED_PAIRS, *((name.partition("-")[0], name) for name in names if "-" in name)]
    for a, b in asked:
        if a in names and b in names:
            yield ", ".join(differing_switches(find_method(a), find_method(b))), a, b


def contrasts_table(rows: Sequence[EpisodeRow]) -> Table:
    """Each pair and metric that both have: the second minus the first, its interval, p corrected over the table.

    What is the same in every cluster could not have been found to differ, and is not counted (Tarone 1990).
    """
    told: list[tuple[str, str, str, str, PairedComparison]] = []
    for switch, a, b in method_pairs(methods_of(rows)):
        for name in CONTRAST_METRICS:
            found = compare(*pair_values(rows, b, a, METRIC_BY_NAME[name].value_of), difference)
            if found.clusters > 1:
                told.append((switch, a, b, name, found))
    corrected = holm_correction([nan if found.is_identical else found.p for *_, found in told])
    lines = [
        (
            switch,
            f"{b} − {a}",
            name,
            format_number(found.effect, unit),
            "all alike"
            if found.is_identical
            else f"[{format_number(found.low, unit)}, {format_number(found.high, unit)}]",
            format_number(p),
            format_number(found.dz),
            str(found.clusters),
        )
        for (switch, a, b, name, found), p in zip(told, corrected, strict=True)
        for unit in [METRIC_BY_NAME[name].unit]
    ]
    head = ("switches", "methods", "metric", "difference", "95 %", "p (Holm)", "d_z", "clusters")
    return Table(
        "From one method to another", head, tuple(lines), "at the places of both; no pair but these was looked at"
    )
