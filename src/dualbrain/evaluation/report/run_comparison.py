"""Two evaluations side by side: what changed, method by method, and in what they were set up otherwise."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from math import isfinite, nan
from typing import Any

import msgspec

from dualbrain.evaluation.analysis.hypotheses import paired
from dualbrain.evaluation.analysis.metrics import BY_NAME, MAIN, Metric
from dualbrain.evaluation.analysis.statistics import LEVEL, Compared, compare, difference, holm
from dualbrain.evaluation.report.tables import NONE, Grid, methods_of, number
from dualbrain.evaluation.results.episode_row import Row

BEFORE, AFTER = "before", "after"
OF_MACHINES = ("gate time", "filter step")
"""Metrics that tell of the machine, and how busy it was, before they tell of a method."""
UNSAID = "says"
"""Entry of a configuration that is words alone."""


@dataclass(frozen=True, slots=True)
class Change:
    """One metric of one method: after − before on common places; `p` is corrected, NaN for what is not counted."""

    method: str
    metric: Metric
    found: Compared
    p: float

    @property
    def word(self) -> str:
        """What may be said of it: a direction only where the corrected p bears it."""
        if not isfinite(self.found.low + self.found.high):
            return "not known"
        if self.found.alike:
            return "the same"
        if self.metric.name in OF_MACHINES:
            return "of the machine"
        if self.p > 1.0 - LEVEL or not self.found.effect:
            return "no clear change"
        return "better" if self.found.effect * self.metric.better > 0.0 else "worse"


def changed(before: Sequence[Row], after: Sequence[Row]) -> list[Change]:
    """Every metric of every method that both have.

    The correction counts neither what is the same in every cluster, which could not have been found to differ (Tarone
    1990), nor what is the machine's.
    """
    told: list[tuple[str, Metric, Compared]] = []
    for method in [name for name in methods_of(before) if name in methods_of(after)]:
        sides = [(BEFORE, before), (AFTER, after)]
        renamed = [
            msgspec.structs.replace(row, method=name) for name, rows in sides for row in rows if row.method == method
        ]
        for name in MAIN:
            found = compare(*paired(renamed, AFTER, BEFORE, BY_NAME[name].of), difference)
            if found.clusters:
                told.append((method, BY_NAME[name], found))
    corrected = holm([nan if metric.name in OF_MACHINES or found.alike else found.p for _, metric, found in told])
    return [Change(*one, p) for one, p in zip(told, corrected, strict=True)]


def changes(before: Sequence[Row], after: Sequence[Row]) -> Grid:
    """The table of what `changed`."""
    head = ("method", "metric", "after − before", "95 %", "p (Holm)", "clusters", "word")
    note = (
        "on the places and words that both have; clusters as in the first; the word goes by p, which is corrected over "
        f"what differs anywhere and is not of the machine ({', '.join(OF_MACHINES)})"
    )
    return Grid("Changes", head, tuple(map(_line, changed(before, after))), note)


def otherwise(before: dict[str, Any], after: dict[str, Any]) -> Grid:
    """Which entries of two configurations differ; of lists, what only one of them has."""
    head = ("configuration", BEFORE, AFTER)
    return Grid("What was set up otherwise", head, tuple(_differing(before, after)), "suite, methods, code, adapters")


def _differing(before: dict[str, Any], after: dict[str, Any], path: str = "") -> Iterator[tuple[str, str, str]]:
    """(path, before, after) of each entry that differs. A method that only one has stands in its suite's list."""
    for name in sorted(before | after):
        a, b, here = before.get(name), after.get(name), f"{path}{name}"
        if a == b or name == UNSAID or (path == "methods." and None in (a, b)):
            continue
        if isinstance(a, dict) and isinstance(b, dict):
            yield from _differing(a, b, f"{here}.")
        elif isinstance(a, list) and isinstance(b, list):
            ours, theirs = [one for one in a if one not in b], [one for one in b if one not in a]
            yield (here, _told(ours), _told(theirs)) if ours or theirs else (here, _told(a), _told(b))
        else:
            yield here, _told(a), _told(b)


def _told(value: Any) -> str:
    """A value of a configuration for a person."""
    if value in (None, [], {}):
        return NONE
    match value:
        case list():
            return ", ".join(map(_told, value))
        case dict():
            return " ".join(_told(one) for one in value.values() if one not in ([], {}))
        case _:
            return str(value)


def _line(one: Change) -> tuple[str, ...]:
    found, unit = one.found, one.metric.unit
    interval = f"[{number(found.low, unit)}, {number(found.high, unit)}]"
    return (
        one.method, one.metric.name, number(found.effect, unit), interval, number(one.p), str(found.clusters), one.word
    )  # fmt: skip
