"""Two evaluations side by side: what changed, method by method, and in what they were set up otherwise."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from math import isfinite, nan
from typing import Any

import msgspec

from dualbrain.evaluation.analysis.hypotheses import pair_values
from dualbrain.evaluation.analysis.metrics import MAIN_METRICS, METRIC_BY_NAME, Metric
from dualbrain.evaluation.analysis.statistics import (
    CONFIDENCE_LEVEL,
    PairedComparison,
    compare,
    difference,
    holm_correction,
)
from dualbrain.evaluation.report.tables import DASH, Table, format_number, methods_of
from dualbrain.evaluation.results.episode_row import EpisodeRow

BEFORE, AFTER = "before", "after"
MACHINE_DEPENDENT_METRICS = ("gate time", "filter step")
"""Metrics that tell of the machine, and how busy it was, before they tell of a method."""
DESCRIPTION_KEY = "says"
"""Entry of a configuration that is words alone."""


@dataclass(frozen=True, slots=True)
class MetricChange:
    """One metric of one method: after − before on common places; `p` is corrected, NaN for what is not counted."""

    method: str
    metric: Metric
    comparison: PairedComparison
    p: float

    @property
    def conclusion(self) -> str:
        """What may be said of it: a direction only where the corrected p bears it."""
        if not isfinite(self.comparison.low + self.comparison.high):
            return "not known"
        if self.comparison.is_identical:
            return "the same"
        if self.metric.name in MACHINE_DEPENDENT_METRICS:
            return "of the machine"
        if self.p > 1.0 - CONFIDENCE_LEVEL or not self.comparison.effect:
            return "no clear change"
        return "better" if self.comparison.effect * self.metric.better_sign > 0.0 else "worse"


def compute_changes(before: Sequence[EpisodeRow], after: Sequence[EpisodeRow]) -> list[MetricChange]:
    """Every metric of every method that both have.

    The correction counts neither what is the same in every cluster, which could not have been found to differ (Tarone
    1990), nor what is the machine's.
    """
    told: list[tuple[str, Metric, PairedComparison]] = []
    for method in [name for name in methods_of(before) if name in methods_of(after)]:
        sides = [(BEFORE, before), (AFTER, after)]
        renamed = [
            msgspec.structs.replace(row, method=name) for name, rows in sides for row in rows if row.method == method
        ]
        for name in MAIN_METRICS:
            found = compare(*pair_values(renamed, AFTER, BEFORE, METRIC_BY_NAME[name].value_of), difference)
            if found.clusters:
                told.append((method, METRIC_BY_NAME[name], found))
    corrected = holm_correction(
        [
            nan if metric.name in MACHINE_DEPENDENT_METRICS or found.is_identical else found.p
            for _, metric, found in told
        ]
    )
    return [MetricChange(*one, p) for one, p in zip(told, corrected, strict=True)]


def changes_table(before: Sequence[EpisodeRow], after: Sequence[EpisodeRow]) -> Table:
    """The table of what `changed`."""
    head = ("method", "metric", "after − before", "95 %", "p (Holm)", "clusters", "word")
    note = (
        "on the places and words that both have; clusters as in the first; the word goes by p, which is corrected over "
        f"what differs anywhere and is not of the machine ({', '.join(MACHINE_DEPENDENT_METRICS)})"
    )
    return Table("Changes", head, tuple(map(_table_row, compute_changes(before, after))), note)


def config_differences_table(before: dict[str, Any], after: dict[str, Any]) -> Table:
    """Which entries of two configurations differ; of lists, what only one of them has."""
    head = ("configuration", BEFORE, AFTER)
    return Table(
        "What was set up otherwise", head, tuple(_diff_entries(before, after)), "suite, methods, code, adapters"
    )


def _diff_entries(before: dict[str, Any], after: dict[str, Any], path: str = "") -> Iterator[tuple[str, str, str]]:
    """(path, before, after) of each entry that differs. A method that only one has stands in its suite's list."""
    for name in sorted(before | after):
        a, b, here = before.get(name), after.get(name), f"{path}{name}"
        if a == b or name == DESCRIPTION_KEY or (path == "methods." and None in (a, b)):
            continue
        if isinstance(a, dict) and isinstance(b, dict):
            yield from _diff_entries(a, b, f"{here}.")
        elif isinstance(a, list) and isinstance(b, list):
            ours, theirs = [one for one in a if one not in b], [one for one in b if one not in a]
            yield (
                (here, _format_value(ours), _format_value(theirs))
                if ours or theirs
                else (here, _format_value(a), _format_value(b))
            )
        else:
            yield here, _format_value(a), _format_value(b)


def _format_value(value: Any) -> str:
    """A value of a configuration for a person."""
    if value in (None, [], {}):
        return DASH
    match value:
        case list():
            return ", ".join(map(_format_value, value))
        case dict():
            return " ".join(_format_value(one) for one in value.values() if one not in ([], {}))
        case _:
            return str(value)


def _table_row(one: MetricChange) -> tuple[str, ...]:
    found, unit = one.comparison, one.metric.unit
    interval = f"[{format_number(found.low, unit)}, {format_number(found.high, unit)}]"
    return (
        one.method,
        one.metric.name,
        format_number(found.effect, unit),
        interval,
        format_number(one.p),
        str(found.clusters),
        one.conclusion,
    )
