"""`guard_fetch` and `guard_metaworld` behind careful and careless policies, in the suites themselves."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache
from statistics import median
from typing import Any

from benchmarks.guards.mocap_guard.virtual_environments import SUITES, create
from experiments.engine.experiment import Options, Row, WorkUnit
from experiments.engine.worker_process import WorkerProcess
from experiments.figures.tables import format_proportion, markdown_table

TASKS = {
    "FetchReach": "fetch",
    "FetchPush": "fetch",
    "FetchPickAndPlace": "fetch",
    "reach-v3": "metaworld",
    "push-v3": "metaworld",
    "pick-place-v3": "metaworld",
    "reach-wall-v3": "metaworld",
}
POLICIES = ("careful", "straight", "low", "random")
AIMING = ("careful", "straight")
"""Policies that have a task."""
OPTION_MODES = {"fetch": "guarded, 12 mm", "metaworld": "guarded, table ignored"}
"""The mode of each suite with an option of the guard; only the careful policy runs in it."""
BOUNDS = {"fetch": (20, 60), "metaworld": (25, 60)}
"""Bounds of the deviation of hand and arm [mm] of the mode "guarded"."""
FIRST_SEED, N_SEEDS, SEEDS_PER_BATCH = 91_300, 20, 4


class MocapGuard:
    """Both adapters, judged by the overlaps of shapes in every step of the simulation."""

    name = "mocap_guard"
    claim = (
        "In the Fetch environments of gymnasium-robotics and in metaworld, no link of the arm touches anything but the "
        "manipulated object behind `guard_fetch` and `guard_metaworld`, for careful and careless policies; a careful "
        "policy succeeds as often as without them, if need be with an option of the guard."
    )

    def units(self, options: Options) -> list[WorkUnit]:
        """All conditions of a batch of seeds; a seed is one start in all modes."""
        del options
        return [
            WorkUnit(
                f"{task} {policy} {mode} {seed}",
                {"suite": suite, "task": task, "policy": policy, "mode": mode, "seed": seed},
            )
            for first in range(FIRST_SEED, FIRST_SEED + N_SEEDS, SEEDS_PER_BATCH)
            for task, suite in TASKS.items()
            for policy in POLICIES
            for mode in modes(suite, policy)
            for seed in range(first, first + SEEDS_PER_BATCH)
        ]

    def run(self, parameters: dict[str, Any]) -> Row:
        """One episode; the environment of the suite is created if it is missing."""
        return _process(parameters["suite"]).run(parameters)

    def summarize_row(self, row: Row) -> str:
        """The outcome."""
        end = f"success after {row['success']} steps" if row["success"] else f"{row['steps']} steps"
        return f"{end}; {_contacts(row) or 'no contact'}"

    def report(self, rows: list[Row]) -> list[str]:
        """Results of every condition, statistics of the guard, totals, and every exception."""
        groups = [(key, some) for key in _conditions() if (some := [row for row in rows if _key(row) == key])]
        by_key = dict(groups)
        lines = markdown_table(_RESULT_HEAD, (_result_row(key, some, by_key) for key, some in groups))
        guarded = [(key, some) for key, some in groups if key[2] != "unguarded"]
        lines += markdown_table(_GUARD_HEAD, (_guard_row(key, some) for key, some in guarded))
        return [*lines, *_totals(rows), "", *_exceptions(guarded, by_key)]


def modes(suite: str, policy: str) -> tuple[str, ...]:
    """The modes of a policy."""
    return ("unguarded", "guarded", OPTION_MODES[suite]) if policy == "careful" else ("unguarded", "guarded")


@cache
def _process(suite: str) -> WorkerProcess:
    """The process of a suite, opened once per worker."""
    return WorkerProcess(SUITES[suite], create(suite), "benchmarks.guards.mocap_guard.worker", suite)


def _key(row: Row) -> tuple[str, str, str]:
    return row["task"], row["policy"], row["mode"]


def _conditions() -> list[tuple[str, str, str]]:
    return [
        (task, policy, mode) for policy in POLICIES for task, suite in TASKS.items() for mode in modes(suite, policy)
    ]


def _contacts(row: Row) -> str:
    return ", ".join(f"{pair} {1e3 * depth:.1f} mm" for pair, depth in row["depth"].items())


_RESULT_HEAD = (
    "policy",
    "task",
    "mode",
    "success",
    "episodes with a contact",
    "deepest",
    "median time to success",
    "of unguarded at the same seeds",
)


def _result_row(
    key: tuple[str, str, str], rows: list[Row], by_key: dict[tuple[str, str, str], list[Row]]
) -> tuple[object, ...]:
    task, policy, mode = key
    successes = [row for row in rows if row["success"]]
    depth = max((one for row in rows for one in row["depth"].values()), default=None)
    unguarded = {row["seed"]: row["time"] for row in by_key.get((task, policy, "unguarded"), []) if row["success"]}
    ratios = [row["time"] / unguarded[row["seed"]] for row in successes if row["seed"] in unguarded]
    return (
        policy,
        task,
        mode,
        format_proportion(len(successes), len(rows)) if policy in AIMING else "no task",
        format_proportion(sum(bool(row["depth"]) for row in rows), len(rows)),
        "" if depth is None else f"{1e3 * depth:.1f} mm",
        f"{median(row['time'] for row in successes):.2f} s" if successes else "",
        f"{median(ratios):.1f} times" if ratios and mode != "unguarded" else "",
    )


_GUARD_HEAD = (
    "policy",
    "task",
    "mode",
    "largest deviation of hand / arm",
    "episodes with a stop",
    "steps of rest",
    "steps changed",
    "smallest h",
    "filter per action, median",
    "99 %, worst episode",
)


def _guard_row(key: tuple[str, str, str], rows: list[Row]) -> tuple[object, ...]:
    steps = sum(row["steps"] for row in rows)
    changed = sum(count for row in rows for status, count in row["status"].items() if status != "SAFE")
    return (
        *(key[1], key[0], key[2]),
        f"{1e3 * max(row['deviation'] for row in rows):.0f} / {1e3 * max(row['arm_deviation'] for row in rows):.0f} mm",
        format_proportion(sum(row["stops"] > 0 for row in rows), len(rows)),
        f"{sum(row['stops'] for row in rows) / steps:.1%}",
        f"{changed / steps:.0%}",
        f"{1e3 * min(row['h_min'] for row in rows):.1f} mm",
        f"{median(row['filter_ms'][0] for row in rows):.1f} ms",
        f"{max(row['filter_ms'][1] for row in rows):.1f} ms",
    )


def _totals(rows: list[Row]) -> list[str]:
    lines: list[str] = []
    for suite, package in SUITES.items():
        some = [row for row in rows if row["suite"] == suite]
        if not some:
            continue
        parts = [
            f"{name} {format_proportion(sum(bool(row['depth']) for row in group), len(group))}"
            for name in ("unguarded", "guarded")
            if (group := [row for row in some if row["mode"].partition(",")[0] == name])
        ]
        pairs = _pairs(some)
        versions = ", ".join(f"{name} {version}" for name, version in some[0]["versions"].items())
        lines.append(
            f"- {package}: episodes with a contact {', '.join(parts)}. {len(pairs)} guarded episodes have an unguarded "
            f"one with the same start; starts that differ: {sum(not same for same in pairs)}. {versions}."
        )
    return lines


def _pairs(rows: list[Row]) -> list[bool]:
    """For each guarded episode with an unguarded one of the same seed: whether both begin alike."""
    starts = {(r["task"], r["policy"], r["seed"]): r["start"] for r in rows if r["mode"] == "unguarded"}
    guarded = [row for row in rows if row["mode"] != "unguarded"]
    keys = [((row["task"], row["policy"], row["seed"]), row["start"]) for row in guarded]
    return [starts[key] == start for key, start in keys if key in starts]


def _exceptions(
    guarded: Iterable[tuple[tuple[str, str, str], list[Row]]], by_key: dict[tuple[str, str, str], list[Row]]
) -> list[str]:
    """Every guarded episode with a contact, and every one without success where the unguarded one succeeds."""
    found: list[tuple[object, ...]] = []
    for (task, policy, _), rows in guarded:
        good = {row["seed"] for row in by_key.get((task, policy, "unguarded"), []) if row["success"]}
        for row in rows:
            lost = policy in AIMING and not row["success"] and row["seed"] in good
            if row["depth"] or lost:
                tool, goal = row["end"]["tool"], row["end"]["goal"]
                miss = [round(1e3 * (b - a)) for a, b in zip(tool, goal, strict=True)]
                found.append((row["key"], _contacts(row), "lost" if lost else "", row["stops"], miss, row["last"][:90]))
    if not found:
        return ["No guarded episode had a contact, or failed where the unguarded one succeeded."]
    return markdown_table(_EXCEPTION_HEAD, found)


_EXCEPTION_HEAD = (
    "guarded episode",
    "contacts",
    "success",
    "steps of rest",
    "goal from the tool at the end [mm]",
    "last report",
)
