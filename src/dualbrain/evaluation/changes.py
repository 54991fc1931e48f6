"""Two evaluations side by side: what changed, method by method."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import msgspec

from dualbrain.evaluation.grids import Grid, methods_of, number
from dualbrain.evaluation.hypotheses import paired
from dualbrain.evaluation.metrics import BY_NAME, MAIN, Metric
from dualbrain.evaluation.row import Row
from dualbrain.evaluation.statistics import Compared, compare, difference, holm

BEFORE, AFTER = "before", "after"


@dataclass(frozen=True, slots=True)
class Change:
    """One metric of one method: after − before on common places."""

    method: str
    metric: Metric
    found: Compared


def changes(before: Sequence[Row], after: Sequence[Row]) -> Grid:
    """Every metric of every method that both have; `better` says which way it went, if the interval leaves out 0."""
    told: list[Change] = []
    for method in [name for name in methods_of(before) if name in methods_of(after)]:
        sides = [(BEFORE, before), (AFTER, after)]
        renamed = [
            msgspec.structs.replace(row, method=name) for name, rows in sides for row in rows if row.method == method
        ]
        for name in MAIN:
            found = compare(*paired(renamed, AFTER, BEFORE, BY_NAME[name].of), difference)
            if found.clusters:
                told.append(Change(method, BY_NAME[name], found))
    corrected = holm([one.found.p for one in told])
    lines = [_line(one, p) for one, p in zip(told, corrected, strict=True)]
    head = ("method", "metric", "after − before", "95 %", "p (Holm)", "clusters", "word")
    return Grid("Changes", head, tuple(lines), "on the places and words that both have; clusters as in the first")


def _line(one: Change, p: float) -> tuple[str, ...]:
    found, unit = one.found, one.metric.unit
    interval = f"[{number(found.low, unit)}, {number(found.high, unit)}]"
    return (
        one.method, one.metric.name, number(found.effect, unit), interval, number(p), str(found.clusters), _word(one)
    )  # fmt: skip


def _word(one: Change) -> str:
    found = one.found
    if found.low <= 0.0 <= found.high:
        return "no clear change" if found.effect else "the same"
    return "better" if found.effect * one.metric.better > 0.0 else "worse"
