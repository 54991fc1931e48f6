"""Table of the episodes in which a barrier value h was below 0, by cause."""

from __future__ import annotations

from collections.abc import Sequence

from dualbrain.evaluation.report.tables import Table, format_number, methods_of
from dualbrain.evaluation.results.episode_row import EpisodeRow
from dualbrain.records import MARGIN_CAUSE_TEXTS, MarginCause

NOT_RECORDED = "cause not recorded"
NOTE = (
    "h is the barrier value of the filter on perceived data, not a distance of ground truth; a margin that is "
    "introduced at a rate has h ≥ 0 and is counted in a line of its own"
)


def margins_table(rows: Sequence[EpisodeRow]) -> Table:
    """Share of the filtered episodes with h < 0 and its least value by method, then the shares by cause."""
    moved = [row for row in rows if row.guarded and row.h_min is not None]
    methods = methods_of(moved)
    by_method = [[row for row in moved if row.method == method] for method in methods]
    causes = [*(cause.value for cause in MarginCause), NOT_RECORDED]
    causes += [f"{cause.value} (introduced)" for cause in MarginCause]
    lines = [
        ("h below 0", *(_share([row for row in some if _is_short(row)], some) for some in by_method)),
        ("least h [mm]", *(f"{1e3 * min(row.h_min or 0.0 for row in some):.2f}" for some in by_method)),
    ]
    for cause in causes:
        found = [[row for row in some if cause in _causes(row)] for some in by_method]
        if any(found):
            shares = (_share(hits, some) for hits, some in zip(found, by_method, strict=True))
            lines.append((_label(cause), *shares))
    return Table("Margins", ("episodes with", *methods), tuple(lines) if methods else (), NOTE)


def _is_short(row: EpisodeRow) -> bool:
    return row.h_min is not None and row.h_min < 0.0


def _causes(row: EpisodeRow) -> set[str]:
    """The causes of an episode; results of earlier versions have none."""
    if _is_short(row) and not row.margin_causes:
        return {NOT_RECORDED}
    return set(row.margin_causes)


def _label(cause: str) -> str:
    name, introduced, _ = cause.partition(" (introduced)")
    if name == NOT_RECORDED:
        return name
    return MARGIN_CAUSE_TEXTS[MarginCause(name)] + (" (introduced at a rate)" if introduced else "")


def _share(hits: Sequence[EpisodeRow], some: Sequence[EpisodeRow]) -> str:
    return format_number(len(hits) / len(some), "share")
