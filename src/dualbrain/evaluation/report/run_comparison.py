"""Comparison of two evaluations: changes of metrics by method, and differences of their configurations."""

from __future__ import annotations

from collections import Counter
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
"""Metrics that depend on the machine and its load more than on the method."""
CLEAR_CONCLUSIONS = ("better", "worse")
"""Conclusions that state the direction of a change."""
DESCRIPTION_KEY = "says"
"""Stored name of a configuration entry that only describes."""


@dataclass(frozen=True, slots=True)
class MetricChange:
    """Change of one metric of one method, after − before on common cases; `p` is corrected, NaN if not counted."""

    method: str
    metric: Metric
    comparison: PairedComparison
    p: float

    @property
    def conclusion(self) -> str:
        """The change in words; a direction only if the corrected p value supports it."""
        if self.comparison.is_identical:
            return "identical"
        if not isfinite(self.comparison.low + self.comparison.high):
            return "not known"
        if self.metric.name in MACHINE_DEPENDENT_METRICS:
            return "machine-dependent"
        if self.p > 1.0 - CONFIDENCE_LEVEL or not self.comparison.effect:
            return "no clear change"
        return "better" if self.comparison.effect * self.metric.better_sign > 0.0 else "worse"


def compute_changes(before: Sequence[EpisodeRow], after: Sequence[EpisodeRow]) -> list[MetricChange]:
    """Change of every metric of every method that both evaluations ran.

    The correction leaves out comparisons that are identical in every cluster, which cannot be significant (Tarone
    1990), and machine-dependent metrics.
    """
    compared: list[tuple[str, Metric, PairedComparison]] = []
    for method in [name for name in methods_of(before) if name in methods_of(after)]:
        sides = [(BEFORE, before), (AFTER, after)]
        renamed = [
            msgspec.structs.replace(row, method=name) for name, rows in sides for row in rows if row.method == method
        ]
        for name in MAIN_METRICS:
            found = compare(*pair_values(renamed, AFTER, BEFORE, METRIC_BY_NAME[name].value_of), difference)
            if found.clusters:
                compared.append((method, METRIC_BY_NAME[name], found))
    corrected = holm_correction(
        [
            nan if metric.name in MACHINE_DEPENDENT_METRICS or found.is_identical else found.p
            for _, metric, found in compared
        ]
    )
    return [MetricChange(*one, p) for one, p in zip(compared, corrected, strict=True)]


def clear_changes(changes: Sequence[MetricChange]) -> list[MetricChange]:
    """The changes whose direction is known."""
    return [one for one in changes if one.conclusion in CLEAR_CONCLUSIONS]


def count_unclear_changes(changes: Sequence[MetricChange]) -> str:
    """How many of the changes have no known direction, by conclusion, as words; "" if all have one."""
    counts = Counter(one.conclusion for one in changes if one.conclusion not in CLEAR_CONCLUSIONS)
    return ", ".join(f"{count} {conclusion}" for conclusion, count in counts.most_common())


def changes_table(changes: Sequence[MetricChange]) -> Table:
    """Table of changes."""
    header = ("method", "metric", "after − before", "95 %", "p (Holm)", "clusters", "conclusion")
    note = (
        "on the cases and instructions that both evaluations ran, in the clusters of the first; the conclusion follows "
        "p, corrected over all comparisons that are neither identical nor machine-dependent "
        f"({', '.join(MACHINE_DEPENDENT_METRICS)})"
    )
    return Table("Changes", header, tuple(map(_table_row, changes)), note)


def config_differences_table(before: dict[str, Any], after: dict[str, Any]) -> Table:
    """Table of the configuration entries that differ; for lists, the elements that only one side has."""
    header = ("configuration", BEFORE, AFTER)
    return Table(
        "Configuration differences", header, tuple(_diff_entries(before, after)), "suite, methods, code, adapters"
    )


def _diff_entries(before: dict[str, Any], after: dict[str, Any], path: str = "") -> Iterator[tuple[str, str, str]]:
    """Yield (path, before, after) for each entry that differs.

    Methods that only one side has are not listed here: they appear in the method list of the suite.
    """
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
    """A configuration value as text."""
    if value in (None, [], {}):
        return DASH
    match value:
        case list():
            return ", ".join(map(_format_value, value))
        case dict():
            return " ".join(_format_value(one) for one in value.values() if one not in ([], {}))
        case _:
            return str(value)


def _table_row(change: MetricChange) -> tuple[str, ...]:
    found, unit = change.comparison, change.metric.unit
    interval = f"[{format_number(found.low, unit)}, {format_number(found.high, unit)}]"
    return (
        change.method,
        change.metric.name,
        format_number(found.effect, unit),
        interval,
        format_number(change.p),
        str(found.clusters),
        change.conclusion,
    )
