"""Figures of the front page, computed from the committed results.

    python -m tools.results.front_page

Reads docs/results/{paper,scenes,cross}/results.parquet and the log of the experiment `tick`, and writes
docs/results/front_page.md.
"""

from __future__ import annotations

import lzma
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec

from dualbrain.evaluation.analysis.hypotheses import HypothesisResult, evaluate_hypotheses, pair_values
from dualbrain.evaluation.analysis.metrics import METRIC_BY_NAME, Metric
from dualbrain.evaluation.analysis.statistics import PairedComparison, compare, difference, estimate
from dualbrain.evaluation.protocol.method import METHODS
from dualbrain.evaluation.report.tables import (
    DASH,
    Table,
    estimate_metric,
    format_estimate,
    format_number,
    markdown_table,
    values_by_cluster,
)
from dualbrain.evaluation.results.episode_row import EpisodeRow
from dualbrain.evaluation.results.parquet import RESULTS_FILE, read_results

ROOT = Path(__file__).resolve().parents[2]
RESULTS = ROOT / "docs" / "results"
PAGE_FILE = "front_page.md"
TICK_LOGS = "experiments/**/tick.jsonl.xz"
METHODS_SHOWN = ("B1", "G", "B3", "B4", "M", "PE", "P", "Full")
COLLISION_KINDS = {"collision_env", "collision_human", "collision_held", "self_collision"}
FRAGILE_FAMILY, FRAGILE_FORCE = "fragile_transfer", "force_fragile"

Condition = Callable[[EpisodeRow], bool | None]
"""Whether an episode has a property; None if it does not count."""


def main() -> int:
    """Write the page."""
    rows = {name: read_results(RESULTS / name / RESULTS_FILE)[0] for name in ("paper", "scenes", "cross")}
    [log] = ROOT.glob(TICK_LOGS)
    ticks = [msgspec.json.decode(line) for line in lzma.decompress(log.read_bytes()).splitlines()]
    path = RESULTS / PAGE_FILE
    path.write_text("\n".join(page_lines(rows, ticks)), encoding="utf-8")
    print(path)
    return 0


def page_lines(rows: Mapping[str, Sequence[EpisodeRow]], ticks: Sequence[dict[str, Any]]) -> list[str]:
    """Lines of the page."""
    lines = [
        "# Figures of the front page",
        "",
        "`python -m tools.results.front_page` computes this page from the committed results and from the log of the "
        "experiment `tick`. Intervals are 95 % intervals over clusters (runs); "
        "[statistics.md](../explanation/statistics.md) describes them.",
        "",
    ]
    tables = [
        main_table(rows["paper"]),
        methods_table(),
        clearance_table(rows),
        hypotheses_table({name: evaluate_hypotheses(some) for name, some in rows.items()}),
        robots_table(rows["cross"]),
        decision_table(rows),
        tick_table(ticks),
    ]
    return [*lines, *(line for table in tables for line in markdown_table(table))]


def main_table(rows: Sequence[EpisodeRow]) -> Table:
    """Suite paper: success, collisions, violations, broken glasses, false successes and Δ of each method."""
    lines = [main_row(name, [row for row in rows if row.method == name]) for name in METHODS_SHOWN]
    header = (
        "method",
        "success",
        "collisions",
        "any violation",
        "glass broken",
        "false among claimed successes",
        "Δ of successes",
    )
    note = (
        "simulated Panda, four task families at two levels, measured on ground truth; a collision is a contact of the "
        "robot or its payload with a person, an object or itself; glass can break in the fragile-transfer episodes; a "
        "claimed success is false if the ground truth disagrees; B2 has the results of B1 and G"
    )
    return Table("Suite paper", header, tuple(lines), note)


def main_row(name: str, rows: Sequence[EpisodeRow]) -> tuple[str, ...]:
    """Row of one method."""
    return (
        name,
        format_estimate(estimate_metric(rows, name, "success"), "rate"),
        count_with_interval(rows, collides),
        format_estimate(estimate_metric(rows, name, "any violation"), "rate"),
        count_with_interval(rows, breaks_glass),
        count_with_interval(rows, is_false_success),
        format_estimate(estimate_metric(rows, name, "Δ of successes"), "1"),
    )


def methods_table() -> Table:
    """The methods, with their descriptions."""
    return Table(
        "Methods", ("method", "description"), tuple((name, METHODS[name].description) for name in METHODS_SHOWN)
    )


def clearance_table(rows: Mapping[str, Sequence[EpisodeRow]]) -> Table:
    """How often and how far the clearance h was below zero, by suite and method."""
    lines = [
        clearance_row(suite, name, [row for row in some if row.method == name])
        for suite, some in rows.items()
        for name in METHODS_SHOWN
        if any(row.method == name for row in some)
    ]
    header = (
        "suite, method",
        "episodes with h below 0",
        "worst h [mm]",
        "time with h below 0",
        "longest in an episode [s]",
    )
    note = (
        "the clearance h includes the declared margins, so h < 0 is a violated margin, not a contact; of the episodes "
        "in which the robot moved; B1 and G have no filter, and their h is that of a filter that only measures"
    )
    return Table("Violated margins", header, tuple(lines), note)


def clearance_row(suite: str, name: str, rows: Sequence[EpisodeRow]) -> tuple[str, ...]:
    """Row of one suite and method."""
    moved = [row for row in rows if row.h_min is not None]
    worst = min(row.h_min for row in moved if row.h_min is not None)
    below, total = sum(row.below_s for row in moved), sum(row.motion_s for row in moved)
    return (
        f"{suite}, {name}",
        count_with_interval(rows, lambda row: None if row.h_min is None else row.h_min < 0.0),
        f"{1e3 * worst:.1f}".replace("-", "−"),
        f"{below:.1f} of {total:.0f} s ({format_number(below / total, 'share')})",
        f"{max(row.below_s for row in moved):.2f}",
    )


def hypotheses_table(results: dict[str, Sequence[HypothesisResult]]) -> Table:
    """Verdicts on the hypotheses by suite, with the effect and the interval of each claim."""
    lines = [
        (f"{suite}, {result.name}", result.verdict, "; ".join(claim.summary_line() for claim in result.claims))
        for suite, some in results.items()
        for result in some
        if result.verdict != "not measured"
    ]
    return Table("Hypotheses", ("suite, hypothesis", "verdict", "claims"), tuple(lines), "by the rule of evaluation.md")


def robots_table(rows: Sequence[EpisodeRow]) -> Table:
    """H2 in suite cross by robot: which robot carries the verdict."""
    lines: list[tuple[str, ...]] = []
    for robot in sorted({row.robot for row in rows}):
        own = [row for row in rows if row.robot == robot]
        [claim] = evaluate_hypotheses(own)[1].claims
        largest = max((row.Delta or 0.0 for row in own if row.guarded), default=0.0)
        lines.append((robot, claim.verdict, effect(claim.found), str(claim.found.clusters), f"{largest:.3g}"))
    header = (
        "robot",
        "verdict for this robot alone",
        "ratio M/B4 of Δ",
        "clusters",
        "largest Δ of a filtered episode",
    )
    return Table("H2 by robot (suite cross)", header, tuple(lines), "required: at most 0.8")


def decision_table(rows: Mapping[str, Sequence[EpisodeRow]]) -> Table:
    """Decision times of the methods with memory, which the paper's H2 names besides Δ."""
    lines: list[tuple[str, ...]] = []
    for suite, some in rows.items():
        if any(row.method == "M" for row in some):
            times = [format_estimate(estimate_metric(some, name, "decision time"), "s") for name in ("B4", "M")]
            found = compare(*pair_values(some, "M", "B4", METRIC_BY_NAME["decision time"].value_of), difference)
            lines.append((suite, *times, effect(found)))
    header = ("suite", "B4, static memory", "M, dynamic memory", "M − B4 on common cases")
    note = "mean ± standard deviation; the verdict on H2 does not include the decision time"
    return Table("Decision time [s]", header, tuple(lines), note)


def effect(found: PairedComparison) -> str:
    """Text "effect [95 % interval]"."""
    return f"{format_number(found.effect)} [{format_number(found.low)}, {format_number(found.high)}]"


def tick_table(rounds: Sequence[dict[str, Any]]) -> Table:
    """Commands to the robot: the simulation in lockstep, and both parts that may move the joints, in real time."""
    loop, thread = (_round_figures([row for row in rounds if row["variant"] == one]) for one in ("loop", "thread"))
    names = ("measured time", "periods", "periods without a command", "longest time between commands")
    lockstep = ("the simulation waits", DASH, "0", "1 ms")
    note = (
        "1 kHz tick of the gatekeeper, with planner, recorder and live view running; in brackets the least and the "
        "largest share of a round (experiment `tick`)"
    )
    header = ("", "lockstep, simulated time", "real time, loop in Python", "real time, control thread in C")
    return Table("Control rate", header, tuple(zip(names, lockstep, loop, thread, strict=True)), note)


def _round_figures(rows: Sequence[dict[str, Any]]) -> tuple[str, ...]:
    periods, silent = (sum(row[key] for row in rows) for key in ("robot_ticks", "silent_periods"))
    shares = [row["silent_periods"] / row["robot_ticks"] for row in rows]
    return (
        f"{sum(row['wall_s'] for row in rows) / 60.0:.1f} minutes",
        str(periods),
        f"{silent} ({silent / periods:.3%}) [{min(shares):.3%}, {max(shares):.3%}]",
        f"{1e3 * max(row['longest_silence'] for row in rows):.1f} ms",
    )


def count_with_interval(rows: Iterable[EpisodeRow], condition: Condition) -> str:
    """Text "hits of n (95 % interval)" of the episodes that count."""
    metric = Metric(name="", unit="rate", description="", value_of=_as_number(condition), better_sign=0)
    found = estimate(values_by_cluster(list(rows), metric), is_rate=True)
    if not found.n:
        return DASH
    low, high = (format_number(end, "rate").removesuffix(" %") for end in (found.low, found.high))
    return f"{round(found.mean * found.n)} of {found.n}: {format_number(found.mean, 'rate')} [{low}, {high}]"


def _as_number(condition: Condition) -> Callable[[EpisodeRow], float | None]:
    def value_of(row: EpisodeRow) -> float | None:
        holds = condition(row)
        return None if holds is None else float(holds)

    return value_of


def collides(row: EpisodeRow) -> bool:
    """Whether the robot or its payload touched a person, an object or itself."""
    return any(violation.kind in COLLISION_KINDS for violation in row.violations)


def breaks_glass(row: EpisodeRow) -> bool | None:
    """Whether the force on the fragile object was too high; None in other families."""
    if row.family != FRAGILE_FAMILY:
        return None
    return any(violation.kind == FRAGILE_FORCE for violation in row.violations)


def is_false_success(row: EpisodeRow) -> bool | None:
    """Whether the ground truth contradicts a success that the robot reports; None if it reports none."""
    return not row.success if row.claimed else None


if __name__ == "__main__":
    raise SystemExit(main())
