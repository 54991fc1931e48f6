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

from dualbrain.control.control_loop import TickSnapshot
from experiments.engine.experiment import Options, Row, WorkUnit
from dualbrain.core.storage.jsonl_log import JsonlLog
from experiments.figures.tables import format_proportion, markdown_table
from experiments.planning.competent_contracts import Task, make_task, task_parameters
from experiments.robots.grasping import check_lift
from experiments.safety.closed_loop import (
    ContractRun,
    count_violations,
    describe_outcome,
    describe_violations,
    run_contract,
    run_row,
    succeeded,
)

N_FEASIBLE_TASKS = 200
"""Feasible tasks."""
MAX_FAILED_SHARE = 0.02
"""Share of them that the filter may make fail."""
MIN_LIFT = 0.05
"""A picked thing is at least this far above where it stood, at the end [m]."""
PLACEMENT_ERROR_PATTERN = re.compile(r"([\d.]+) cm from the goal")


class Conservatism:
    """The filter lets through what is safe."""

    name = "conservatism"
    claim = f"Of {N_FEASIBLE_TASKS} feasible tasks the filter makes at most {MAX_FAILED_SHARE:.0%} fail; the time it adds is told."

    def units(self, options: Options) -> list[WorkUnit]:
        """The first tasks of the fixed order: one more for each that was found infeasible so far; call again to end."""
        found = {
            row["key"]: row.get("feasible", True) for row in JsonlLog(options.folder / f"{self.name}.jsonl").latest()
        }
        units: list[WorkUnit] = []
        missing = N_FEASIBLE_TASKS
        for unit in (WorkUnit(_unit_key(about), about) for about in task_parameters()):
            if missing == 0:
                break
            units.append(unit)
            missing -= found.get(unit.key, True)
        return units

    def run(self, about: dict[str, Any]) -> Row:
        """Filter off; and on, if that was safe."""
        what = make_task(**about)
        off = _run_task(what, guard=False)
        feasible = _is_safe(off)
        on = _run_task(what, guard=True) if feasible else None
        return {**about, "feasible": feasible, "actions": what.actions, "off": off, "on": on}

    def summarize_row(self, row: Row) -> str:
        """Both ends."""
        if not row["feasible"]:
            return f"infeasible: {describe_outcome(row['off'])}"
        return f"off {row['off']['duration']:.1f} s; on {describe_outcome(row['on'])}"

    def report(self, rows: list[Row]) -> list[str]:
        """Share that fails, added time, shares by family and kind, every failure."""
        place = {key: index for index, key in enumerate(map(_unit_key, task_parameters()))}
        flown = sorted((row for row in rows if row["key"] in place), key=lambda row: place[row["key"]])
        good = [row for row in flown if row["feasible"]][:N_FEASIBLE_TASKS]
        lost = [row for row in good if not _is_safe(row["on"])]
        hurt = dict(count_violations([row["on"] for row in good])) or "none"
        lines = [
            f"Made to fail by the filter: **{format_proportion(len(lost), len(good))}** feasible tasks; at most {MAX_FAILED_SHARE:.0%} wanted.",
            f"Tasks flown: {len(flown)}. Violations with the filter on: {hurt}.",
            "",
            _added_time(good),
            "",
            *markdown_table(("", "flown", "feasible", "made to fail"), _breakdown(flown, good, lost)),
        ]
        return lines + (
            markdown_table(("task", "reason", "depth", "binding rows", "violations"), map(_failure_row, lost))
            if lost
            else []
        )


def _run_task(what: Task, *, guard: bool) -> Row:
    """One flight in figures, with what bound at its end."""
    last: list[str] = []

    def watch(moment: TickSnapshot) -> None:
        if moment.result.binding_rows:
            last[:] = [f"{moment.nominal.phase}: {moment.result.explain()}"]

    flight = run_contract(
        what.spec, what.actions, seed=what.spec.seed, settle_s=1.0, goal=what.goal, guard=guard, on_tick=watch
    )
    figures = run_row(flight)
    if figures["valid"]:
        figures["truth"] = _succeeded_on_truth(flight, what)
        figures["bound"] = "" if succeeded(figures) else "".join(last)
    return figures


def _succeeded_on_truth(flight: ContractRun, what: Task) -> bool:
    """Success on simulator truth: the goal, or the thing in the hand; a mere journey ends where the robot says."""
    if what.goal:
        return flight.judgement.success
    return check_lift(flight.plant, what.object_name)[1] > MIN_LIFT if what.kind == "pick" else True


def _is_safe(flown: Row) -> bool:
    return flown["valid"] and succeeded(flown) and not flown["violations"]


def _unit_key(about: dict[str, Any]) -> str:
    return f"{about['family']}:{about['seed']} {about['kind']}"


def _added_time(good: list[Row]) -> str:
    """How much longer the same task takes with the filter, where both succeed."""
    pairs = np.array([(r["off"]["duration"], r["on"]["duration"]) for r in good if _is_safe(r["on"])]).reshape(-1, 2)
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


def _failure_row(row: Row) -> tuple[object, ...]:
    on = row["on"]
    depth = PLACEMENT_ERROR_PATTERN.search(on["reason"])
    return (
        row["key"],
        on["reason"],
        f"{depth[1]} cm" if depth else "",
        on.get("bound", ""),
        describe_violations(on),
    )
