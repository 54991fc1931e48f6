"""conservatism: what the filter costs on tasks that succeed safely without it.

A *task* is a scene (family and seed), an errand drawn for it, and a contract whose parameters follow the planner's own
rules from the scene's symbols (`tasks.py`); nobody is asked. It is flown twice under the same seeds, first with the
filter off, then on. It is *feasible* when the flight without filter succeeds by its own word and on simulator truth,
and the monitor notes no violation of any kind. The order of the tasks is fixed before any is flown, and the first 200
feasible ones count. Of these, the filter *makes fail* those whose flight with it does not succeed without violation.

Selection: infeasible tasks are those in which the same contract and the same skills collide, drop or miss by
themselves; what the filter makes of them is not counted here. A feasible flight may still have passed a neighbour
within a millimetre by luck, which no filter with a perception error of 9 mm may allow.
"""

from __future__ import annotations

import re
from collections import Counter
from typing import Any

import numpy as np

from dualbrain.control.control_loop import Moment
from experiments.engine.experiment import Options, Row, Unit
from experiments.engine.jsonl_log import Journal
from experiments.figures.tables import share, table
from experiments.planning.competent_contracts import Task, all_tasks, task
from experiments.robots.grasping import held
from experiments.safety.closed_loop import Flight, fly, kinds, outcome_words, row, succeeded, violation_words

WANTED = 200
"""Feasible tasks."""
MOST = 0.02
"""Share of them that the filter may make fail."""
LIFTED = 0.05
"""A picked thing is at least this far above where it stood, at the end [m]."""
DEPTH = re.compile(r"([\d.]+) cm from the goal")


class Conservatism:
    """The filter lets through what is safe."""

    name = "conservatism"
    claim = f"Of {WANTED} feasible tasks the filter makes at most {MOST:.0%} fail; the time it adds is told."

    def units(self, options: Options) -> list[Unit]:
        """The first tasks of the fixed order: one more for each that was found infeasible so far; call again to end."""
        found = {row["key"]: row.get("feasible", True) for row in Journal(options.folder / f"{self.name}.jsonl").rows()}
        units: list[Unit] = []
        missing = WANTED
        for unit in (Unit(_key(about), about) for about in all_tasks()):
            if missing == 0:
                break
            units.append(unit)
            missing -= found.get(unit.key, True)
        return units

    def run(self, about: dict[str, Any]) -> Row:
        """Filter off; and on, if that was safe."""
        what = task(**about)
        off = _flown(what, guard=False)
        feasible = _safe(off)
        on = _flown(what, guard=True) if feasible else None
        return {**about, "feasible": feasible, "actions": what.actions, "off": off, "on": on}

    def brief(self, row: Row) -> str:
        """Both ends."""
        if not row["feasible"]:
            return f"infeasible: {outcome_words(row['off'])}"
        return f"off {row['off']['duration']:.1f} s; on {outcome_words(row['on'])}"

    def report(self, rows: list[Row]) -> list[str]:
        """Share that fails, added time, shares by family and kind, every failure."""
        place = {key: index for index, key in enumerate(map(_key, all_tasks()))}
        flown = sorted((row for row in rows if row["key"] in place), key=lambda row: place[row["key"]])
        good = [row for row in flown if row["feasible"]][:WANTED]
        lost = [row for row in good if not _safe(row["on"])]
        hurt = dict(kinds([row["on"] for row in good])) or "none"
        lines = [
            f"Made to fail by the filter: **{share(len(lost), len(good))}** feasible tasks; at most {MOST:.0%} wanted.",
            f"Tasks flown: {len(flown)}. Violations with the filter on: {hurt}.", "", _added(good), "",
            *table(("", "flown", "feasible", "made to fail"), _breakdown(flown, good, lost)),
        ]  # fmt: skip
        return lines + (
            table(("task", "reason", "depth", "binding rows", "violations"), map(_failure, lost)) if lost else []
        )


def _flown(what: Task, *, guard: bool) -> Row:
    """One flight in figures, with what bound at its end."""
    last: list[str] = []

    def watch(moment: Moment) -> None:
        if moment.result.rows:
            last[:] = [f"{moment.nominal.phase}: {moment.result.explain()}"]

    flight = fly(what.spec, what.actions, seed=what.spec.seed, hold=1.0, goal=what.goal, guard=guard, watch=watch)
    figures = row(flight)
    if figures["valid"]:
        figures["truth"] = _true(flight, what)
        figures["bound"] = "" if succeeded(figures) else "".join(last)
    return figures


def _true(flight: Flight, what: Task) -> bool:
    """Success on simulator truth: the goal, or the thing in the hand; a mere journey ends where the robot says."""
    if what.goal:
        return flight.judgement.success
    return held(flight.plant, what.thing)[1] > LIFTED if what.kind == "pick" else True


def _safe(flown: Row) -> bool:
    return flown["valid"] and succeeded(flown) and not flown["violations"]


def _key(about: dict[str, Any]) -> str:
    return f"{about['family']}:{about['seed']} {about['kind']}"


def _added(good: list[Row]) -> str:
    """How much longer the same task takes with the filter, where both succeed."""
    pairs = np.array([(r["off"]["duration"], r["on"]["duration"]) for r in good if _safe(r["on"])]).reshape(-1, 2)
    if not len(pairs):
        return "No task succeeded both ways yet."
    added = pairs[:, 1] - pairs[:, 0]
    median, p90, most = np.median(added), np.quantile(added, 0.9), added.max()
    return (
        f"Added time over {len(added)} tasks that succeed both ways: median {median:.2f} s, p90 {p90:.2f} s, "
        f"max {most:.2f} s; in all {added.sum() / pairs[:, 0].sum():.1%} of the time without filter."
    )


def _breakdown(flown: list[Row], good: list[Row], lost: list[Row]) -> list[tuple[object, ...]]:
    lines: list[tuple[object, ...]] = []
    for field in ("family", "kind"):
        counts = [Counter(row[field] for row in some) for some in (flown, good, lost)]
        lines += [(value, *(count[value] for count in counts)) for value in sorted(counts[0])]
    return lines


def _failure(row: Row) -> tuple[object, ...]:
    on = row["on"]
    depth = DEPTH.search(on["reason"])
    return (
        row["key"], on["reason"], f"{depth[1]} cm" if depth else "", on.get("bound", ""),
        violation_words(on),
    )  # fmt: skip
