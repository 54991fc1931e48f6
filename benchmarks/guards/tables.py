"""Tables of the benchmark: contacts, safe successes, added time and cost, by guard and policy."""

from __future__ import annotations

from statistics import median
from typing import Any

import numpy as np

from benchmarks.guards.episode import GUARDS
from experiments.figures.tables import format_share_by_scene, markdown_table

Row = dict[str, Any]
OWN_GUARDS = ("dualbrain", "dualbrain, along path")
UNGUARDED = "unguarded"
GOAL_FREE_POLICY = "random"


def summary(rows: list[Row]) -> list[str]:
    """Episodes and contacts of each guard over all policies, and the claim's comparison."""
    own = [row["guards"][guard] for row in rows for guard in OWN_GUARDS]
    contacts = sum(found["contact"] for found in own)
    least = min(min(found["min_scene_distance"], found["min_self_distance"]) for found in own)
    cells = [
        (guard, len(rows), _contacts(rows, guard), _safe_success(rows, guard), _kept_success(rows, guard, safe=False))
        for guard in GUARDS
    ]
    head = ["guard", "episodes", "with contact", "safe successes (policies with a goal)"]
    head += ["safe successes where the unguarded policy has none"]
    return [
        f"Episodes behind dualbrain: **{len(own)}**, with contact: **{contacts}**; smallest distance of any link "
        f"{least * 1e3:.1f} mm.",
        "",
        *markdown_table(head, cells),
        "",
    ]


def policy_section(policy: str, rows: list[Row]) -> list[str]:
    """The table of one policy."""
    head = ["guard", "with contact"]
    head += ["reached the goal without contact", "of those safe when unguarded", "added time"]
    head += ["guard per action of 20 ms, median / 99 %"]
    cells = [
        (
            guard,
            _contacts(rows, guard),
            _safe_success(rows, guard),
            _kept_success(rows, guard),
            _added_time(rows, guard),
            _cost(rows, guard),
        )
        for guard in GUARDS
    ]
    return [f"### {policy}", "", *markdown_table(head, cells), ""]


def is_safe_success(found: Row) -> bool:
    """Whether the goal was reached without any contact."""
    return found["reached"] is not None and not found["contact"]


def _contacts(rows: list[Row], guard: str) -> str:
    return format_share_by_scene([(str(row["seed"]), bool(row["guards"][guard]["contact"])) for row in rows])


def _safe_success(rows: list[Row], guard: str) -> str:
    some = [row for row in rows if row["policy"] != GOAL_FREE_POLICY]
    if not some:
        return "–"
    return format_share_by_scene([(str(row["seed"]), is_safe_success(row["guards"][guard])) for row in some])


def _kept_success(rows: list[Row], guard: str, *, safe: bool = True) -> str:
    """Safe successes among the episodes in which the unguarded policy succeeded safely, or did not."""
    goals = [row for row in rows if row["policy"] != GOAL_FREE_POLICY]
    some = [row for row in goals if is_safe_success(row["guards"][UNGUARDED]) == safe]
    if not some:
        return "–"
    return format_share_by_scene([(str(row["seed"]), is_safe_success(row["guards"][guard])) for row in some])


def _added_time(rows: list[Row], guard: str) -> str:
    """Median of the additional time where the policy succeeds safely with and without the guard."""
    both = [
        row["guards"][guard]["reached"] - row["guards"][UNGUARDED]["reached"]
        for row in rows
        if is_safe_success(row["guards"][guard]) and is_safe_success(row["guards"][UNGUARDED])
    ]
    return f"{median(both):+.2f} s" if both else "–"


def _cost(rows: list[Row], guard: str) -> str:
    middle, late = np.median([row["guards"][guard]["action_us"] for row in rows], axis=0) / 1e3
    return f"{middle:.2f} / {late:.2f} ms"
