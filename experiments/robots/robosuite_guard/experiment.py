"""`guard_robosuite` in robosuite's Lift, Stack and PickPlaceCan, behind its default controller."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache
from statistics import mean
from typing import Any

from experiments.engine.experiment import Options, Row, WorkUnit
from experiments.engine.worker_process import WorkerProcess
from experiments.figures.tables import format_proportion, markdown_table
from experiments.robots.robosuite_guard.virtual_environment import create

TASKS = ("Lift", "Stack", "PickPlaceCan")
POLICIES = ("careful", "careless", "random")
MODES = ("clamped", "unguarded", "guarded")
"""The actions of the policy clamped to 1 cm and 0.1 rad per step; directly; behind `guard_robosuite`."""
N_SEEDS, SEEDS_PER_BATCH = 14, 7


class RobosuiteGuard:
    """The adapter for robosuite, judged by MuJoCo's contacts and robosuite's success check."""

    name = "robosuite_guard"
    claim = (
        "In robosuite's Lift, Stack and PickPlaceCan with its default controller (OSC_POSE, 20 Hz), `guard_robosuite` "
        "keeps arm and hand off everything but the manipulated object, for careful, careless and random policies; a "
        "careful policy succeeds as often as without it."
    )

    def units(self, options: Options) -> list[WorkUnit]:
        """The guarded, unguarded and clamped episodes of a batch of seeds; a seed is one start state in all modes."""
        del options
        return [
            WorkUnit(f"{task} {policy} {mode} {seed}", {"task": task, "policy": policy, "mode": mode, "seed": seed})
            for first in range(0, N_SEEDS, SEEDS_PER_BATCH)
            for mode in reversed(MODES)
            for seed in range(first, first + SEEDS_PER_BATCH)
            for task in TASKS
            for policy in POLICIES
        ]

    def run(self, parameters: dict[str, Any]) -> Row:
        """One episode; the suite's environment is created if it is missing."""
        return _suite().run(parameters)

    def summarize_row(self, row: Row) -> str:
        """The outcome."""
        contacts = ", ".join(f"{pair} {force:.3g} N" for pair, force in row["outside"].items())
        return f"{'success' if row['success'] else 'no success'} in {row['steps']} steps; {contacts or 'no contact'}"

    def report(self, rows: list[Row]) -> list[str]:
        """Results of every condition, statistics of the guard, and every guarded episode that failed."""
        groups = [(key, some) for key in _conditions() if (some := [row for row in rows if _key(row) == key])]
        lines = markdown_table(_RESULT_HEAD, (_result_row(key, some) for key, some in groups))
        guarded = [(key, some) for key, some in groups if key[2] == "guarded"]
        unguarded = {key[:2]: some for key, some in groups if key[2] == "unguarded"}
        lines += markdown_table(
            _GUARD_HEAD, (_guard_row(key, some, unguarded.get(key[:2], [])) for key, some in guarded)
        )
        return [*lines, _totals(rows), "", *_exceptions(row for _, some in guarded for row in some)]


@cache
def _suite() -> WorkerProcess:
    """The suite's process, opened once per worker."""
    return WorkerProcess("robosuite", create(), "experiments.robots.robosuite_guard.worker")


def _key(row: Row) -> tuple[str, str, str]:
    return row["task"], row["policy"], row["mode"]


def _conditions() -> list[tuple[str, str, str]]:
    return [(task, policy, mode) for policy in POLICIES for task in TASKS for mode in MODES]


def worst_force(contacts: Iterable[dict[str, float]]) -> float:
    """The largest normal force [N] in the contacts of some episodes; 0 without a contact."""
    return max((force for found in contacts for force in found.values()), default=0.0)


_RESULT_HEAD = (
    "policy",
    "task",
    "mode",
    "success",
    "episodes with a contact outside",
    "largest force",
    "links in contact with each other",
)


def _result_row(key: tuple[str, str, str], rows: list[Row]) -> tuple[object, ...]:
    task, policy, mode = key
    force = worst_force(row["outside"] for row in rows)
    return (
        policy,
        task,
        mode,
        "no task" if policy == "random" else format_proportion(sum(row["success"] for row in rows), len(rows)),
        format_proportion(sum(bool(row["outside"]) for row in rows), len(rows)),
        f"{force:.3g} N" if force else "",
        sum(bool(row["links"]) for row in rows),
    )


_GUARD_HEAD = (
    "policy",
    "task",
    "steps with a changed torque",
    "relaxed / stopped / fault",
    "smallest h",
    "largest tracking error, share of the bound",
    "mean steps",
    "mean steps unguarded",
    "processor time per step",
    "unguarded",
)


def _guard_row(key: tuple[str, str, str], rows: list[Row], without: list[Row]) -> tuple[object, ...]:
    task, policy, _ = key
    steps = sum(row["steps"] for row in rows)
    status = [sum(row["status"].get(name, 0) for row in rows) for name in ("RELAXED", "STOPPED", "FAULT")]
    return (
        policy,
        task,
        f"{sum(row['changed'] for row in rows) / steps:.1%}",
        " / ".join(map(str, status)),
        f"{min(row['h_min'] for row in rows) * 1e3:.2f} mm",
        f"{max(row['strayed'] for row in rows):.2f}",
        f"{mean(row['steps'] for row in rows):.0f}",
        f"{mean(row['steps'] for row in without):.0f}" if without else "",
        f"{mean(row['cpu'] for row in rows):.0f} ms",
        f"{mean(row['cpu'] for row in without):.0f} ms" if without else "",
    )


def _totals(rows: list[Row]) -> str:
    parts: list[str] = []
    for mode in MODES:
        some = [row for row in rows if row["mode"] == mode]
        if some:
            count = sum(bool(row["outside"]) for row in some)
            parts.append(f"{mode} {format_proportion(count, len(some))}")
    versions = ", ".join(f"{name} {version}" for name, version in rows[0]["versions"].items())
    return f"Episodes with such a contact, of all tasks and policies: {'; '.join(parts)}. {versions}."


def _exceptions(rows: Iterable[Row]) -> list[str]:
    """Every guarded episode with a contact, a fault, or without success."""
    found = [
        (row["key"], row["success"], _contacts(row), row["status"].get("FAULT", 0), f"{row['h_min'] * 1e3:.2f} mm")
        for row in rows
        if row["outside"]
        or row["links"]
        or row["status"].get("FAULT")
        or not (row["success"] or row["policy"] == "random")
    ]
    if not found:
        return ["No guarded episode had a contact or a fault, or failed."]
    return markdown_table(("guarded episode", "success", "contacts", "steps with a fault", "smallest h"), found)


def _contacts(row: Row) -> str:
    return "; ".join(f"{pair} {force:.3g} N" for pair, force in {**row["outside"], **row["links"]}.items()) or "none"
