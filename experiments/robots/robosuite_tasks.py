"""robosuite's Lift and Stack, judged by its own success check, with and without the filter in the loop."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache
from statistics import mean
from typing import Any

from dualbrain.robots.model import RobotModel
from experiments.engine.experiment import Options, Row, WorkUnit
from experiments.figures.tables import format_proportion, markdown_table
from experiments.robots.robosuite.episode import MODES, calibrated_robot, run_episode
from experiments.robots.robosuite.limit_monitor import UNITS
from experiments.robots.robosuite.suite_process import SuiteProcess
from experiments.robots.robosuite.tracking import ACCELERATION_SHARES, SPEED_SHARES
from experiments.robots.robosuite.virtual_environment import create

N_SEEDS = 20
BOTH_MODES = ("unfiltered", "filtered")
CONDITIONS = (
    ("Lift", "hasty", BOTH_MODES),
    ("Stack", "hasty", BOTH_MODES),
    ("Lift", "careful", BOTH_MODES),
    ("Stack", "careful", BOTH_MODES),
)
CONTROL_CONDITIONS = (("Lift", "random", BOTH_MODES), ("Lift", "hasty", ("clipped",)), ("Stack", "hasty", ("clipped",)))
"""Task, policy and modes; at one seed, all of them start from the same state. The controls come last."""
SEEDS_PER_BATCH = 5
"""Number of consecutive seeds of one condition."""


class RobosuiteTasks:
    """The filter in a foreign task suite."""

    name = "robosuite_tasks"
    claim = (
        "In robosuite's Lift and Stack, with its own physics, torque controller and success check, the filter keeps a "
        "hasty policy within all joint limits and off table, mount and other cube; a careful policy succeeds as often "
        "as without the filter."
    )

    def units(self, options: Options) -> list[WorkUnit]:
        """A few seeds of every condition, then the next few."""
        del options
        return [
            WorkUnit(f"{task} {policy} {mode} {seed}", {"task": task, "policy": policy, "how": mode, "seed": seed})
            for conditions in (CONDITIONS, CONTROL_CONDITIONS)
            for first in range(0, N_SEEDS, SEEDS_PER_BATCH)
            for task, policy, modes in conditions
            for seed in range(first, first + SEEDS_PER_BATCH)
            for mode in modes
        ]

    def run(self, parameters: dict[str, Any]) -> Row:
        """One episode; the suite's environment is created if it is missing."""
        suite, robot_model = _open_suite()
        return run_episode(suite, robot_model, parameters)

    def summarize_row(self, row: Row) -> str:
        """The outcome."""
        worst = ", ".join(f"{kind} {peak:.3g} {UNITS[kind]}" for kind, peak in worst_peaks([row]).items())
        return (
            f"{'success' if row['success'] else 'no success'} after {row['time']:.1f} s; {worst or 'no limit exceeded'}"
        )

    def report(self, rows: list[Row]) -> list[str]:
        """Results of every condition, worst breaches, statistics of the filter, tracking, exceptions."""
        groups = [
            (key, some) for key in _all_conditions() if (some := [row for row in rows if _condition_of(row) == key])
        ]
        lines = markdown_table(_RESULT_HEAD, (_result_row(key, some) for key, some in groups))
        lines += markdown_table(_WORST_HEAD, (_worst_row(key, some) for key, some in groups if worst_peaks(some)))
        unfiltered = {key[:2]: mean(row["time"] for row in some) for key, some in groups if key[2] == "unfiltered"}
        lines += markdown_table(
            _FILTER_HEAD, (_filter_row(key, some, unfiltered) for key, some in groups if key[2] == "filtered")
        )
        return [*lines, *_tracking_lines(rows), "", *_exception_lines(rows)]


@cache
def _open_suite() -> tuple[SuiteProcess, RobotModel]:
    """The suite's process and the robot model of the filter, opened once per worker."""
    create()
    suite = SuiteProcess()
    return suite, calibrated_robot(suite)


def exceeded_limit(row: Row, kind: str) -> bool:
    """Whether a limit of this kind was exceeded in an episode."""
    return any(breach["kind"] == kind for breach in row["breaches"])


def touched_object(row: Row, name: str) -> bool:
    """Whether the robot touched the object `name` although it must not."""
    return any(breach["kind"] == "touch" and name in breach["between"] for breach in row["breaches"])


def is_clean(row: Row) -> bool:
    """Whether no limit was exceeded and no forbidden contact occurred."""
    return not row["breaches"]


def worst_peaks(rows: Iterable[Row]) -> dict[str, float]:
    """The worst peak of each kind of breach."""
    found: dict[str, float] = {}
    for breach in (breach for row in rows for breach in row["breaches"]):
        found[breach["kind"]] = max(found.get(breach["kind"], 0.0), breach["peak"])
    return {kind: found[kind] for kind in UNITS if kind in found}


def _all_conditions() -> list[tuple[str, str, str]]:
    found = {(task, policy, mode) for task, policy, modes in (*CONDITIONS, *CONTROL_CONDITIONS) for mode in modes}
    return sorted(found, key=lambda key: (key[1], key[0], MODES.index(key[2])))


def _condition_of(row: Row) -> tuple[str, str, str]:
    return row["task"], row["policy"], row["how"]


_RESULT_HEAD = (
    "policy",
    "task",
    "mode",
    "success",
    "success without breach",
    "joint velocity",
    "joint position",
    "table touched",
    "mount or own links",
    "cubes touched by hand or arm",
    "other cube pushed > 1 cm",
)
"""From the sixth column on: number of episodes in which it happened."""


def _result_row(key: tuple[str, str, str], rows: list[Row]) -> tuple[object, ...]:
    task, policy, mode = key
    n, has_task = len(rows), policy != "random"
    good = [row for row in rows if row["success"]]
    own = sum(any(_is_self_or_mount_contact(breach) for breach in row["breaches"]) for row in rows)
    return (
        policy,
        task,
        mode,
        format_proportion(len(good), n) if has_task else "no task",
        format_proportion(sum(map(is_clean, good)), n)
        if has_task
        else f"(without breach: {format_proportion(sum(map(is_clean, rows)), n)})",
        sum(exceeded_limit(row, "joint_velocity") for row in rows),
        sum(exceeded_limit(row, "joint_position") for row in rows),
        sum(touched_object(row, "table") for row in rows),
        own,
        sum(any(touched_object(row, cube) for cube in ("cube", "cubeA", "cubeB")) for row in rows),
        sum(row["pushed"] > 0.01 for row in rows) if task == "Stack" else "",
    )


def _is_self_or_mount_contact(breach: dict[str, Any]) -> bool:
    """Whether a breach is a contact with the mount, the floor or another part of the robot."""
    objects = ("table", "cube", "cubeA", "cubeB")
    return breach["kind"] == "touch" and not any(name in objects for name in breach["between"])


_WORST_HEAD = ("policy", "task", "mode", "limit", "episodes", "worst peak", "longest")


def _worst_row(key: tuple[str, str, str], rows: list[Row]) -> tuple[object, ...]:
    """One line per condition, with its kinds of breach below each other."""
    task, policy, mode = key
    worst = worst_peaks(rows)
    longest = {kind: max(b["duration"] for row in rows for b in row["breaches"] if b["kind"] == kind) for kind in worst}
    return (
        policy,
        task,
        mode,
        "<br>".join(kind.replace("_", " ") for kind in worst),
        "<br>".join(str(sum(exceeded_limit(row, kind) for row in rows)) for kind in worst),
        "<br>".join(f"{peak:.3g} {UNITS[kind]}" for kind, peak in worst.items()),
        "<br>".join(f"{longest[kind]:.2f} s" for kind in worst),
    )


_FILTER_HEAD = (
    "policy",
    "task",
    "mean delta",
    "steps modified",
    "relaxed / stopped / fault",
    "smallest h",
    "time",
    "time unfiltered",
    "torque saturated",
    "fastest joint, share of the data sheet",
)


def _filter_row(
    key: tuple[str, str, str], rows: list[Row], unfiltered: dict[tuple[str, ...], float]
) -> tuple[object, ...]:
    task, policy, _ = key
    without = f"{unfiltered[key[:2]]:.1f} s" if key[:2] in unfiltered else "not run"
    steps = sum(row["steps"] for row in rows)
    status = [sum(row["status"][k] for row in rows) for k in range(5)]
    return (
        policy,
        task,
        f"{mean(row['delta'] for row in rows):.3f}",
        f"{status[1] / steps:.1%}",
        " / ".join(str(count) for count in status[2:]),
        f"{min(row['h_min'] for row in rows) * 1e3:.2f} mm",
        f"{mean(row['time'] for row in rows):.1f} s",
        without,
        f"{mean(row['saturated'] for row in rows):.1%}",
        f"{max(row['speed'] for row in rows):.2f}",
    )


def _tracking_lines(rows: list[Row]) -> list[str]:
    """The agreement of the models, and the tracking error."""
    filtered = [row for row in rows if row["how"] == "filtered"]
    apart = max(row["apart"] for row in rows)
    if not filtered:
        return [f"The two models of the arm agree within {apart * 1e3:.4f} mm."]
    allowed, worst = filtered[0]["allowed_error"], max(row["strayed"] for row in filtered)
    within = sum(row["strayed"] <= row["allowed_error"] for row in filtered)
    versions = ", ".join(f"{name} {version}" for name, version in rows[0]["versions"].items())
    return [
        f"{versions}. The two models of the arm agree within {apart * 1e3:.4f} mm. The filter was configured with "
        f"{', '.join(f'{s:.3g}' for s in SPEED_SHARES)} of the data sheet's speeds and "
        f"{', '.join(f'{s:.3g}' for s in ACCELERATION_SHARES)} of its accelerations, a lag of "
        f"{filtered[0]['lag'] * 1e3:.2f} ms and a tracking error of {allowed * 1e3:.2f} mrad, measured before; in the "
        f"filtered episodes the error was at most {worst * 1e3:.2f} mrad, and within the configured bound in "
        f"**{format_proportion(within, len(filtered))}**."
    ]


def _exception_lines(rows: list[Row]) -> list[str]:
    """Every filtered episode that exceeded a limit or, with a task, did not succeed."""
    exceptions = [
        row
        for row in rows
        if row["how"] == "filtered" and not (is_clean(row) and (row["success"] or row["policy"] == "random"))
    ]
    if not exceptions:
        return ["No filtered episode failed or exceeded a limit."]
    return markdown_table(
        ("filtered episode", "success", "breaches"),
        ((r["key"], r["success"], _describe_breaches(r)) for r in exceptions),
    )


def _describe_breaches(row: Row) -> str:
    parts = [
        f"{b['kind'].replace('_', ' ')} {' and '.join(b['between'])} {b['peak']:.3g} {UNITS[b['kind']]}"
        f" at {b['start']:.2f} s"
        for b in row["breaches"]
    ]
    return "; ".join(parts) or "none"
