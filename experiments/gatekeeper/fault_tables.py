"""Tables of the fault injection: a summary by robot and moment, and a matrix per robot by fault and moment."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence

from dualbrain.evaluation.fault_injection.faults import HOST_SOURCES, KINDS, MOBILE_BASE_MOMENTS, MOMENTS
from dualbrain.robots.loader import load_robot
from dualbrain.safety.supervisor.actions import SafetyAction
from experiments.engine.experiment import Row
from experiments.figures.tables import markdown_table

SHORT_NAMES = {"CONTROLLED_STOP": "STOP"}
ACKNOWLEDGEMENT_MOMENT = "between write and acknowledgement"


def summary(rows: list[Row]) -> list[str]:
    """Return episodes and unsafe episodes by robot and by moment, and reaction times by expected action."""
    injected = [row for row in rows if row["struck"] is not None]
    unsafe, other = (sum(not row[name] for row in injected) for name in ("safe", "as_declared"))
    lines = [
        f"Episodes: **{len(rows)}**, in {len(injected)} of which the fault was injected. Unsafe: **{unsafe}**. "
        f"Without the declared action: **{other}**.",
        "",
    ]
    head = ("", "episodes", "fault injected", "unsafe", "without the declared action", "outcomes")
    groups = [(f"robot {name}", [row for row in rows if row["body"] == name]) for name in _robots(rows)]
    groups += [(f"moment: {name}", [row for row in rows if row["fault"][2] == name]) for name in MOMENTS]
    lines += markdown_table(head, ((name, *_counts(group)) for name, group in groups if group))
    head = (
        "least expected action",
        "episodes",
        "actions",
        "reaction, median",
        "reaction, longest",
        "until rest, longest",
    )
    return lines + markdown_table(head, _reactions(injected))


def fault_matrices(rows: list[Row]) -> list[str]:
    """Return a table per robot: declared action of each fault, action at each moment, longest times.

    A cell holds the strongest action of the episode; "–": the moment did not occur, "…": not run.
    """
    lines: list[str] = []
    for robot in _robots(rows):
        cells = {tuple(row["fault"]): row for row in rows if row["body"] == robot}
        moments = MOBILE_BASE_MOMENTS if load_robot(robot).is_mobile else MOMENTS
        columns = ("acknowledgement" if name == ACKNOWLEDGEMENT_MOMENT else name for name in moments)
        head = ("fault", "declared", *columns, "reaction, longest", "until rest, longest")
        lines += [
            f"### {robot}",
            "",
            *markdown_table(head, (_fault_row(cells, s, k, moments) for s in HOST_SOURCES for k in KINDS)),
        ]
    return lines


def _fault_row(cells: dict[tuple[str, ...], Row], source: str, kind: str, moments: Sequence[str]) -> tuple[str, ...]:
    found = [cells.get((source, kind, moment)) for moment in moments]
    finished = [row for row in found if row is not None]
    declared = sorted({row["expected"] for row in finished}, key=lambda name: SafetyAction[name])
    injected = [row for row in finished if row["struck"] is not None]
    cells_of_row = [" or ".join(map(_short_name, declared)), *map(_cell, found)]
    return (
        f"{source} {kind}",
        *cells_of_row,
        _format_worst(row["reaction"] for row in injected),
        _format_worst(map(_time_to_rest, injected)),
    )


def _cell(row: Row | None) -> str:
    if row is None:
        return "…"
    if row["struck"] is None:
        return "–"
    violation = "" if row["safe"] else " UNSAFE"
    return _short_name(row["reached"]) + violation + ("" if row["as_declared"] else " ≠")


def _reactions(injected: list[Row]) -> Iterable[tuple[object, ...]]:
    by_action = defaultdict[str, list[Row]](list)
    for row in injected:
        by_action[row["expected"]].append(row)
    for name in sorted(by_action, key=lambda name: SafetyAction[name]):
        group, reached = by_action[name], Counter(_short_name(row["reached"]) for row in by_action[name])
        times = sorted(row["reaction"] for row in group if row["reaction"] is not None)
        median = f"{1e3 * times[len(times) // 2]:.0f} ms" if times else "–"
        actions = ", ".join(f"{action} {count}" for action, count in reached.most_common())
        yield (
            _short_name(name),
            len(group),
            actions,
            median,
            _format_worst(times),
            _format_worst(map(_time_to_rest, group)),
        )


def _time_to_rest(row: Row) -> float | None:
    """Return the time from the fault until the arm was at rest [s], or None if the fault did not end the contract."""
    return row["rest"] if row["outcome"] in ("stopped", "emergency") else None


def _counts(rows: list[Row]) -> tuple[object, ...]:
    injected = [row for row in rows if row["struck"] is not None]
    unsafe, other = (sum(not row[name] for row in injected) for name in ("safe", "as_declared"))
    outcomes = ", ".join(f"{kind} {count}" for kind, count in Counter(row["outcome"] for row in injected).most_common())
    return len(rows), len(injected), unsafe, other, outcomes


def _format_worst(values: Iterable[float | None]) -> str:
    worst = max((value for value in values if value is not None), default=None)
    return "–" if worst is None else f"{1e3 * worst:.0f} ms"


def _robots(rows: list[Row]) -> list[str]:
    return list(dict.fromkeys(row["body"] for row in sorted(rows, key=lambda row: row["body"])))


def _short_name(action: str) -> str:
    return SHORT_NAMES.get(action, action)
