"""Contrasts: the effect of each step from one method to another, on the cases that both ran."""

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
    ("PE-fixed", "P"),
    ("M", "Full"),
    ("P", "Full"),
    ("B3", "V"),
    ("V", "P"),
    ("A1", "A2"),
    ("A1", "A3"),
    ("A2", "A3"),
)
"""The only pairs that are compared: each further comparison would enlarge the correction of all p values."""
NON_SWITCH_FIELDS = ("name", "description")
"""Fields of a method that are not switches."""


def differing_switches(a: Method, b: Method) -> tuple[str, ...]:
    """Switches in which two methods differ, by their stored names."""
    return tuple(
        one.encode_name
        for one in fields(a)
        if one.name not in NON_SWITCH_FIELDS and getattr(a, one.name) != getattr(b, one.name)
    )


def method_pairs(names: Sequence[str]) -> Iterator[tuple[str, str, str]]:
    """Yield (switches, method, method) for each declared pair, and for each variant `X-…` with its method X."""
    pairs = [*DECLARED_PAIRS, *((name.partition("-")[0], name) for name in names if "-" in name)]
    for a, b in pairs:
        if a in names and b in names:
            yield ", ".join(differing_switches(find_method(a), find_method(b))), a, b


def contrasts_table(rows: Sequence[EpisodeRow]) -> Table:
    """Second minus first method for each pair and metric, with interval and p corrected over the table.

    Comparisons that are identical in every cluster cannot be significant and are not counted (Tarone 1990).
    """
    compared: list[tuple[str, str, str, str, PairedComparison]] = []
    for switch, a, b in method_pairs(methods_of(rows)):
        for name in CONTRAST_METRICS:
            found = compare(*pair_values(rows, b, a, METRIC_BY_NAME[name].value_of), difference)
            if found.clusters > 1:
                compared.append((switch, a, b, name, found))
    corrected = holm_correction([nan if found.is_identical else found.p for *_, found in compared])
    lines = [
        (
            switch,
            f"{b} − {a}",
            name,
            format_number(found.effect, unit),
            "identical"
            if found.is_identical
            else f"[{format_number(found.low, unit)}, {format_number(found.high, unit)}]",
            format_number(p),
            format_number(found.dz),
            str(found.clusters),
        )
        for (switch, a, b, name, found), p in zip(compared, corrected, strict=True)
        for unit in [METRIC_BY_NAME[name].unit]
    ]
    header = ("switches", "methods", "metric", "difference", "95 %", "p (Holm)", "d_z", "clusters")
    return Table("Contrasts", header, tuple(lines), "on the cases that both methods ran; no other pair was compared")
