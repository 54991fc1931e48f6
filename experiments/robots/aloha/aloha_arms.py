"""gym-aloha's two arms, judged by the contacts of its own simulation, with and without the guard."""

from __future__ import annotations

from functools import cache
from statistics import mean
from typing import Any

from experiments.engine.experiment import Options, Row, WorkUnit
from experiments.engine.worker_process import WorkerProcess
from experiments.figures.tables import format_proportion, markdown_table
from experiments.robots.aloha.judge import KINDS
from experiments.robots.aloha.virtual_environment import create

N_SEEDS = 20
HANDS_FREE = "guarded, hands free"
CONDITIONS = (
    ("transfer", "random", ("unguarded", "guarded")),
    ("transfer", "careless", ("unguarded", "guarded", HANDS_FREE)),
    ("transfer", "careful", ("unguarded", HANDS_FREE, "guarded")),
    ("insertion", "random", ("unguarded", "guarded")),
    ("transfer", "random", ("clamped", HANDS_FREE)),
    ("transfer", "careless", ("clamped",)),
    ("insertion", "random", ("clamped",)),
)
"""Task, policy and modes; at one seed, all of them start from the same state."""
SEEDS_PER_BATCH = 5
"""Number of consecutive seeds of one condition."""
FREE_OF_HANDS = ("hand and hand", "hand and table")
"""Kinds of contacts that the guard does not prevent if the hands are free."""
STATUSES = ("MODIFIED", "RELAXED", "STOPPED", "FAULT")


class AlohaArms:
    """Two guarded arms in a foreign environment."""

    name = "aloha_arms"
    claim = (
        "In gym-aloha, with its own servos and simulation, the guard of both arms keeps random and careless policies "
        "from every contact of the arms with each other and with the table; a careful policy whose hands are free to "
        "touch succeeds as often as without the guard."
    )

    def units(self, options: Options) -> list[WorkUnit]:
        """A few seeds of every condition, then the next few."""
        del options
        return [
            WorkUnit(f"{task} {policy} {mode} {seed}", {"task": task, "policy": policy, "mode": mode, "seed": seed})
            for first in range(0, N_SEEDS, SEEDS_PER_BATCH)
            for task, policy, modes in CONDITIONS
            for seed in range(first, first + SEEDS_PER_BATCH)
            for mode in modes
        ]

    def run(self, parameters: dict[str, Any]) -> Row:
        """One episode; the environment of gym-aloha is created if it is missing."""
        return _open_process().run(parameters)

    def summarize_row(self, row: Row) -> str:
        """The outcome."""
        touched = ", ".join(f"{kind} {row['times'][kind]:.2f} s" for kind in KINDS if kind in row["times"])
        return f"reward {row['reward']:.0f} after {0.02 * row['steps']:.1f} s; contacts: {touched or 'none'}"

    def report(self, rows: list[Row]) -> list[str]:
        """Contacts and success of every condition, statistics of the guard, and the exceptions."""
        groups = [(key, some) for key in _all_conditions() if (some := [row for row in rows if _condition(row) == key])]
        lines = markdown_table(_CONTACT_HEAD, (_contact_row(key, some) for key, some in groups))
        guarded = [(key, some) for key, some in groups if "guarded" in key[2] and key[2] != "unguarded"]
        lines += markdown_table(_GUARD_HEAD, (_guard_row(key, some) for key, some in guarded))
        return [*lines, *_summary_lines(rows), "", *_exception_lines(rows)]


@cache
def _open_process() -> WorkerProcess:
    """The process of gym-aloha, opened once per worker."""
    return WorkerProcess("gym-aloha", create(), "experiments.robots.aloha.worker")


def unwanted(row: Row) -> list[str]:
    """The kinds of contacts of an episode, without those that its guard leaves to the hands."""
    free = FREE_OF_HANDS if row["mode"] == HANDS_FREE else ()
    return [kind for kind in KINDS if kind in row["times"] and kind not in free]


def _all_conditions() -> list[tuple[str, str, str]]:
    order = ("unguarded", "clamped", "guarded", HANDS_FREE)
    found = {(task, policy, mode) for task, policy, modes in CONDITIONS for mode in modes}
    return sorted(found, key=lambda key: (key[1], key[0], order.index(key[2])))


def _condition(row: Row) -> tuple[str, str, str]:
    return row["task"], row["policy"], row["mode"]


_CONTACT_HEAD = ("policy", "task", "mode", "success", "no unwanted contact", *KINDS, "fastest joint")
"""Of each kind of contact the number of episodes, and the longest time in one."""


def _contact_row(key: tuple[str, str, str], rows: list[Row]) -> tuple[object, ...]:
    task, policy, mode = key
    return (
        policy,
        task,
        mode,
        "no task" if policy == "random" else format_proportion(sum(row["success"] for row in rows), len(rows)),
        format_proportion(sum(not unwanted(row) for row in rows), len(rows)),
        *(_describe_kind(kind, rows) for kind in KINDS),
        f"{max(row['speed'] for row in rows):.1f} rad/s",
    )


def _describe_kind(kind: str, rows: list[Row]) -> str:
    times = [row["times"][kind] for row in rows if kind in row["times"]]
    return f"{len(times)}, {max(times):.2f} s" if times else "0"


_GUARD_HEAD = (
    "policy",
    "task",
    "mode",
    "steps changed",
    "relaxed / stopped / fault",
    "mean delta",
    "smallest h",
    "largest tracking error, share of the bound",
    "time",
)


def _guard_row(key: tuple[str, str, str], rows: list[Row]) -> tuple[object, ...]:
    task, policy, mode = key
    steps = sum(row["steps"] for row in rows)
    counts = [sum(row["status"].get(status, 0) for row in rows) for status in STATUSES]
    return (
        policy,
        task,
        mode,
        f"{sum(counts) / steps:.1%}",
        " / ".join(str(count) for count in counts[1:]),
        f"{mean(row['cost'] for row in rows):.3f}",
        f"{min(row['h_min'] for row in rows) * 1e3:.1f} mm",
        f"{max(row['tracking'] for row in rows):.2f}",
        f"{0.02 * mean(row['steps'] for row in rows):.1f} s",
    )


def _summary_lines(rows: list[Row]) -> list[str]:
    guarded = [row for row in rows if row["mode"] in ("guarded", HANDS_FREE)]
    versions = ", ".join(f"{name} {version}" for name, version in rows[0]["versions"].items())
    if not guarded:
        return [f"{versions}."]
    within = sum(row["tracking"] <= 1.0 for row in guarded)
    clean = sum(not unwanted(row) for row in guarded)
    return [
        f"{versions}. Guarded episodes without an unwanted contact: **{format_proportion(clean, len(guarded))}**. The "
        f"tracking error was within the bound of the robot model in {format_proportion(within, len(guarded))} of them."
    ]


def _exception_lines(rows: list[Row]) -> list[str]:
    """Every guarded episode with an unwanted contact."""
    exceptions = [row for row in rows if row["mode"] in ("guarded", HANDS_FREE) and unwanted(row)]
    if not exceptions:
        return ["No guarded episode had an unwanted contact."]
    return markdown_table(
        ("guarded episode", "unwanted contacts", "tracking error, share of the bound"),
        (
            (row["key"], ", ".join(f"{kind} {row['times'][kind]:.2f} s" for kind in unwanted(row)), row["tracking"])
            for row in exceptions
        ),
    )
