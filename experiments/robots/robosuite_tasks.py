"""outsider: robosuite's Lift and Stack, judged by its own success check, with and without the filter in the loop."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache
from statistics import mean
from typing import Any

from dualbrain.robots.model import Body
from experiments.engine.experiment import Options, Row, Unit
from experiments.figures.tables import share, table
from experiments.robots.robosuite.episode import HOWS, body_of, fly
from experiments.robots.robosuite.limit_monitor import UNITS
from experiments.robots.robosuite.suite_process import Suite
from experiments.robots.robosuite.tracking import ACCELERATION, SPEED
from experiments.robots.robosuite.virtual_environment import make

SEEDS = 20
BOTH = ("unfiltered", "filtered")
CELLS = (("Lift", "hasty", BOTH), ("Stack", "hasty", BOTH), ("Lift", "careful", BOTH), ("Stack", "careful", BOTH))
CONTROLS = (("Lift", "random", BOTH), ("Lift", "hasty", ("clipped",)), ("Stack", "hasty", ("clipped",)))
"""Task, policy and how it is flown; at a seed all of them see the same start. The controls come last."""
BATCH = 5
"""Seeds of one cell in a row."""


class Outsider:
    """The filter in a task suite that others wrote."""

    name = "robosuite_tasks"
    claim = (
        "In robosuite's Lift and Stack, with its own physics, torque controller and success check, the filter keeps a "
        "hasty policy within every joint limit and off table, mount and other cube; a careful one succeeds as before."
    )

    def units(self, options: Options) -> list[Unit]:
        """A few seeds of every cell, then the next few."""
        del options
        return [
            Unit(f"{task} {policy} {how} {seed}", {"task": task, "policy": policy, "how": how, "seed": seed})
            for cells in (CELLS, CONTROLS)
            for first in range(0, SEEDS, BATCH)
            for task, policy, hows in cells
            for seed in range(first, first + BATCH)
            for how in hows
        ]

    def run(self, about: dict[str, Any]) -> Row:
        """One flight; the environment is made if it is missing."""
        suite, body = _suite()
        return fly(suite, body, about)

    def brief(self, row: Row) -> str:
        """How it ended."""
        worst = ", ".join(f"{kind} {peak:.3g} {UNITS[kind]}" for kind, peak in peaks([row]).items())
        return (
            f"{'success' if row['success'] else 'no success'} after {row['time']:.1f} s; {worst or 'no limit exceeded'}"
        )

    def report(self, rows: list[Row]) -> list[str]:
        """What became of every cell, how bad it was at worst, and what the filter did."""
        cells = [(key, some) for key in _keys() if (some := [row for row in rows if _key(row) == key])]
        lines = table(_HEAD, (_cells(key, some) for key, some in cells))
        lines += table(_WORST, (_worst(key, some) for key, some in cells if peaks(some)))
        bare = {key[:2]: mean(row["time"] for row in some) for key, some in cells if key[2] == "unfiltered"}
        lines += table(_FILTER, (_filter(key, some, bare) for key, some in cells if key[2] == "filtered"))
        return [*lines, *_tracking(rows), "", *_exceptions(rows)]


@cache
def _suite() -> tuple[Suite, Body]:
    """The suite's process and the body that the filter is told of, once a worker."""
    make()
    suite = Suite()
    return suite, body_of(suite)


def exceeded(row: Row, kind: str) -> bool:
    """Whether a limit of this kind was exceeded in a flight."""
    return any(breach["kind"] == kind for breach in row["breaches"])


def touched(row: Row, thing: str) -> bool:
    """Whether the robot touched `thing` where it should not."""
    return any(breach["kind"] == "touch" and thing in breach["between"] for breach in row["breaches"])


def clean(row: Row) -> bool:
    """Whether nothing was exceeded or touched."""
    return not row["breaches"]


def peaks(rows: Iterable[Row]) -> dict[str, float]:
    """The worst peak of each kind."""
    found: dict[str, float] = {}
    for breach in (breach for row in rows for breach in row["breaches"]):
        found[breach["kind"]] = max(found.get(breach["kind"], 0.0), breach["peak"])
    return {kind: found[kind] for kind in UNITS if kind in found}


def _keys() -> list[tuple[str, str, str]]:
    found = {(task, policy, how) for task, policy, hows in (*CELLS, *CONTROLS) for how in hows}
    return sorted(found, key=lambda key: (key[1], key[0], HOWS.index(key[2])))


def _key(row: Row) -> tuple[str, str, str]:
    return row["task"], row["policy"], row["how"]


_HEAD = (
    "policy", "task", "flown", "success", "success, nothing exceeded", "joint velocity", "joint position",
    "table struck", "mount or own parts", "cubes struck by hand or arm", "other cube pushed > 1 cm",
)  # fmt: skip
"""From the sixth on: flights in which it happened."""


def _cells(key: tuple[str, str, str], rows: list[Row]) -> tuple[object, ...]:
    task, policy, how = key
    n, aims = len(rows), policy != "random"
    good = [row for row in rows if row["success"]]
    own = sum(any(_own(breach) for breach in row["breaches"]) for row in rows)
    return (
        policy, task, how, share(len(good), n) if aims else "no task",
        share(sum(map(clean, good)), n) if aims else f"(nothing exceeded: {share(sum(map(clean, rows)), n)})",
        sum(exceeded(row, "joint_velocity") for row in rows), sum(exceeded(row, "joint_position") for row in rows),
        sum(touched(row, "table") for row in rows), own,
        sum(any(touched(row, cube) for cube in ("cube", "cubeA", "cubeB")) for row in rows),
        sum(row["pushed"] > 0.01 for row in rows) if task == "Stack" else "",
    )  # fmt: skip


def _own(breach: dict[str, Any]) -> bool:
    """A touch of the mount, the floor or another part of the robot."""
    things = ("table", "cube", "cubeA", "cubeB")
    return breach["kind"] == "touch" and not any(name in things for name in breach["between"])


_WORST = ("policy", "task", "flown", "limit", "flights", "worst peak", "longest")


def _worst(key: tuple[str, str, str], rows: list[Row]) -> tuple[object, ...]:
    """One line a cell, its kinds of breach beneath each other."""
    task, policy, how = key
    worst = peaks(rows)
    longest = {kind: max(b["duration"] for row in rows for b in row["breaches"] if b["kind"] == kind) for kind in worst}
    return (
        policy, task, how, "<br>".join(kind.replace("_", " ") for kind in worst),
        "<br>".join(str(sum(exceeded(row, kind) for row in rows)) for kind in worst),
        "<br>".join(f"{peak:.3g} {UNITS[kind]}" for kind, peak in worst.items()),
        "<br>".join(f"{longest[kind]:.2f} s" for kind in worst),
    )  # fmt: skip


_FILTER = (
    "policy", "task", "mean delta", "steps modified", "relaxed / stopped / fault", "least h", "time", "time unfiltered",
    "torque saturated", "fastest joint, share of the data sheet",
)  # fmt: skip


def _filter(key: tuple[str, str, str], rows: list[Row], bare: dict[tuple[str, ...], float]) -> tuple[object, ...]:
    task, policy, _ = key
    without = f"{bare[key[:2]]:.1f} s" if key[:2] in bare else "not flown"
    steps = sum(row["steps"] for row in rows)
    status = [sum(row["status"][k] for row in rows) for k in range(5)]
    return (
        policy, task, f"{mean(row['delta'] for row in rows):.3f}", f"{status[1] / steps:.1%}",
        " / ".join(str(count) for count in status[2:]), f"{min(row['h_min'] for row in rows) * 1e3:.2f} mm",
        f"{mean(row['time'] for row in rows):.1f} s", without, f"{mean(row['saturated'] for row in rows):.1%}",
        f"{max(row['speed'] for row in rows):.2f}",
    )  # fmt: skip


def _tracking(rows: list[Row]) -> list[str]:
    """How well the models agree, and how well the arm followed."""
    filtered = [row for row in rows if row["how"] == "filtered"]
    apart = max(row["apart"] for row in rows)
    if not filtered:
        return [f"The two models of the arm agree within {apart * 1e3:.4f} mm."]
    allowed, worst = filtered[0]["allowed_error"], max(row["strayed"] for row in filtered)
    within = sum(row["strayed"] <= row["allowed_error"] for row in filtered)
    versions = ", ".join(f"{name} {version}" for name, version in rows[0]["versions"].items())
    return [
        f"{versions}. The two models of the arm agree within {apart * 1e3:.4f} mm. The filter was told of "
        f"{', '.join(f'{s:.3g}' for s in SPEED)} of the data sheet's speeds and "
        f"{', '.join(f'{s:.3g}' for s in ACCELERATION)} of its accelerations, a lag of "
        f"{filtered[0]['lag'] * 1e3:.2f} ms and a tracking error of {allowed * 1e3:.2f} mrad, measured before; in the "
        f"filtered flights the error was at most {worst * 1e3:.2f} mrad, and within what was told in "
        f"**{share(within, len(filtered))}**."
    ]


def _exceptions(rows: list[Row]) -> list[str]:
    """Every filtered flight that exceeded something or, with a task, did not succeed."""
    bad = [
        row for row in rows
        if row["how"] == "filtered" and not (clean(row) and (row["success"] or row["policy"] == "random"))
    ]  # fmt: skip
    if not bad:
        return ["No filtered flight failed or exceeded anything."]
    return table(("filtered flight", "success", "what was exceeded"), ((r["key"], r["success"], _said(r)) for r in bad))


def _said(row: Row) -> str:
    parts = [
        f"{b['kind'].replace('_', ' ')} {' and '.join(b['between'])} {b['peak']:.3g} {UNITS[b['kind']]}"
        f" at {b['start']:.2f} s"
        for b in row["breaches"]
    ]  # fmt: skip
    return "; ".join(parts) or "nothing"
