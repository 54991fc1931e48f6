"""What was wanted beforehand, and what a run reached: ratios over our median of the same unit."""

from __future__ import annotations

from typing import Any

from benchmarks.peers.benchmarked_filters import OWN

FASTEST = {10: 15.0, 50: 25.0, 100: 25.0, 400: 60.0}
SHIPPED = 40.0
OVER_C = 3.0
IN_C = f"{OWN}, in C"


def bars(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """One record a bar: wanted, reached, by whom, met."""
    found = []
    for n, fastest in FASTEST.items():
        here = [row for row in rows if row["setting"] == "rows" and row["n"] == n and row["ratio"] is not None]
        peers = [row for row in here if not row["ours"]]
        if not peers:
            continue
        found.append(_at_least(f"fastest peer, {n} rows", fastest, peers))
        same = [row for row in peers if row["same_problem"]]
        if len(same) < len(peers):
            found.append(_at_least(f"fastest peer that states every row, {n} rows", fastest, same))
        shipped = [row for row in peers if row["shipped"]]
        if shipped:
            found.append(_at_least(f"cbfpy's default, {n} rows", SHIPPED, shipped))
        in_c = [row for row in here if row["peer"] == IN_C]
        if in_c:
            reached = 1.0 / in_c[0]["ratio"]
            found.append({
                "bar": f"Python over C, {n} rows", "wanted": OVER_C, "reached": reached, "by": IN_C,
                "met": reached <= OVER_C,
            })  # fmt: skip
    return found


def _at_least(bar: str, wanted: float, rows: list[dict[str, Any]]) -> dict[str, Any]:
    nearest = min(rows, key=lambda row: row["ratio"])
    return {
        "bar": bar, "wanted": wanted, "reached": nearest["ratio"], "by": nearest["peer"],
        "met": nearest["ratio"] >= wanted,
    }  # fmt: skip
