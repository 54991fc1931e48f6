"""Targets set before the measurement, and the values reached: ratios to the median of dualbrain in the same unit."""

from __future__ import annotations

from typing import Any

from benchmarks.peers.benchmarked_filters import OWN_NAME

FASTEST_PEER_TARGETS = {10: 15.0, 50: 25.0, 100: 25.0, 400: 60.0}
DEFAULT_PEER_TARGET = 40.0
MAX_PYTHON_OVER_C = 3.0
OWN_IN_C = f"{OWN_NAME}, in C"


def evaluate_targets(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return a record per target: required and reached value, filter, and whether it is met."""
    found = []
    for n, fastest in FASTEST_PEER_TARGETS.items():
        here = [row for row in rows if row["setting"] == "rows" and row["n"] == n and row["ratio"] is not None]
        peers = [row for row in here if not row["ours"]]
        if not peers:
            continue
        found.append(_minimum_target(f"fastest peer, {n} rows", fastest, peers))
        same = [row for row in peers if row["same_problem"]]
        if len(same) < len(peers):
            found.append(_minimum_target(f"fastest peer with all rows, {n} rows", fastest, same))
        shipped = [row for row in peers if row["shipped"]]
        if shipped:
            found.append(_minimum_target(f"cbfpy with its defaults, {n} rows", DEFAULT_PEER_TARGET, shipped))
        in_c = [row for row in here if row["peer"] == OWN_IN_C]
        if in_c:
            reached = 1.0 / in_c[0]["ratio"]
            found.append(
                {
                    "target": f"Python over C, {n} rows",
                    "required": MAX_PYTHON_OVER_C,
                    "reached": reached,
                    "by": OWN_IN_C,
                    "met": reached <= MAX_PYTHON_OVER_C,
                }
            )
    return found


def _minimum_target(target: str, required: float, rows: list[dict[str, Any]]) -> dict[str, Any]:
    nearest = min(rows, key=lambda row: row["ratio"])
    return {
        "target": target,
        "required": required,
        "reached": nearest["ratio"],
        "by": nearest["peer"],
        "met": nearest["ratio"] >= required,
    }
