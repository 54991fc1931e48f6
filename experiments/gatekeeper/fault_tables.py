"""What injected faults led to, as tables: in short by body and moment, and whole by body, fault and moment."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence

from dualbrain.evaluation.fault_injection.faults import KINDS, MOBILE_BASE_MOMENTS, MOMENTS, SOURCES
from dualbrain.robots.loader import load_robot
from dualbrain.safety.supervisor.actions import SafetyAction
from experiments.engine.experiment import Row
from experiments.figures.tables import markdown_table

SHORT_NAMES = {"CONTROLLED_STOP": "STOP"}
ACKNOWLEDGEMENT_MOMENT = "between write and acknowledgement"


def summary(rows: list[Row]) -> list[str]:
    """How many, how many unsafe, by body and by moment; reactions by what was expected."""
    struck = [row for row in rows if row["struck"] is not None]
    unsafe, other = (sum(not row[name] for row in struck) for name in ("safe", "as_declared"))
    lines = [
        f"Episodes: **{len(rows)}**, of which {len(struck)} reached their moment. Unsafe: **{unsafe}**. Declared order "
        f"did not come: **{other}**. The whole matrix: [faults.md](faults.md).",
        "",
    ]
    head = ("", "episodes", "moment reached", "unsafe", "not as declared", "outcomes")
    groups = [(f"body {name}", [row for row in rows if row["body"] == name]) for name in _robots(rows)]
    groups += [(f"moment: {name}", [row for row in rows if row["fault"][2] == name]) for name in MOMENTS]
    lines += markdown_table(head, ((name, *_counts(group)) for name, group in groups if group))
    head = (
        "least order that was expected",
        "struck",
        "orders that came",
        "reaction, median",
        "worst",
        "at rest after, worst",
    )
    return lines + markdown_table(head, _reactions(struck))


def fault_matrices(rows: list[Row]) -> list[str]:
    """A table a body: each fault with the order declared for it, the order that came at each moment, the worst times.

    A cell says the strongest order that came; "–": the moment never came, "…": not flown.
    """
    lines: list[str] = []
    for body in _robots(rows):
        cells = {tuple(row["fault"]): row for row in rows if row["body"] == body}
        moments = MOBILE_BASE_MOMENTS if load_robot(body).is_mobile else MOMENTS
        columns = ("acknowledgement" if name == ACKNOWLEDGEMENT_MOMENT else name for name in moments)
        head = ("fault", "declared", *columns, "reaction, worst", "at rest after, worst")
        lines += [
            f"### {body}",
            "",
            *markdown_table(head, (_fault_row(cells, s, k, moments) for s in SOURCES for k in KINDS)),
        ]
    return lines


def _fault_row(cells: dict[tuple[str, ...], Row], source: str, kind: str, moments: Sequence[str]) -> tuple[str, ...]:
    found = [cells.get((source, kind, moment)) for moment in moments]
    flown = [row for row in found if row is not None]
    declared = sorted({row["expected"] for row in flown}, key=lambda name: SafetyAction[name])
    struck = [row for row in flown if row["struck"] is not None]
    told = [" or ".join(map(_short_name, declared)), *map(_cell, found)]
    return (
        f"{source} {kind}",
        *told,
        _format_worst(row["reaction"] for row in struck),
        _format_worst(map(_time_to_rest, struck)),
    )


def _cell(row: Row | None) -> str:
    if row is None:
        return "…"
    if row["struck"] is None:
        return "–"
    wrong = "" if row["safe"] else " UNSAFE"
    return _short_name(row["reached"]) + wrong + ("" if row["as_declared"] else " ≠")


def _reactions(struck: list[Row]) -> Iterable[tuple[object, ...]]:
    by = defaultdict[str, list[Row]](list)
    for row in struck:
        by[row["expected"]].append(row)
    for name in sorted(by, key=lambda name: SafetyAction[name]):
        group, reached = by[name], Counter(_short_name(row["reached"]) for row in by[name])
        times = sorted(row["reaction"] for row in group if row["reaction"] is not None)
        middle = f"{1e3 * times[len(times) // 2]:.0f} ms" if times else "–"
        came = ", ".join(f"{rung} {count}" for rung, count in reached.most_common())
        yield (
            _short_name(name),
            len(group),
            came,
            middle,
            _format_worst(times),
            _format_worst(map(_time_to_rest, group)),
        )


def _time_to_rest(row: Row) -> float | None:
    """How long after the strike the arm was at rest, where the fault ended its contract."""
    return row["rest"] if row["outcome"] in ("stopped", "emergency") else None


def _counts(rows: list[Row]) -> tuple[object, ...]:
    struck = [row for row in rows if row["struck"] is not None]
    unsafe, other = (sum(not row[name] for row in struck) for name in ("safe", "as_declared"))
    outcomes = ", ".join(f"{kind} {count}" for kind, count in Counter(row["outcome"] for row in struck).most_common())
    return len(rows), len(struck), unsafe, other, outcomes


def _format_worst(values: Iterable[float | None]) -> str:
    worst = max((value for value in values if value is not None), default=None)
    return "–" if worst is None else f"{1e3 * worst:.0f} ms"


def _robots(rows: list[Row]) -> list[str]:
    return list(dict.fromkeys(row["body"] for row in sorted(rows, key=lambda row: row["body"])))


def _short_name(rung: str) -> str:
    return SHORT_NAMES.get(rung, rung)
