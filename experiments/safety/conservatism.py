"""Conservatism of the filter: its cost on tasks that succeed safely without it.

A *task* is a scene (family and seed), an instruction drawn for it, and a contract whose parameters follow the rules of
the planner's prompt applied to the scene's symbols (`competent_contracts.py`); no planner is involved. Each task runs
twice with the same seeds, first without, then with the filter. It is *feasible* if the run without filter succeeds
according to the robot and on ground truth, and the monitor records no violation of any kind. The order of the tasks is
fixed beforehand, and the first 200 feasible ones count. The filter *makes a task fail* if the run with filter does not
succeed without violation.

Selection: in infeasible tasks, the same contract and skills collide, drop or miss without the filter; their runs with
the filter are not counted here. A feasible run may have passed a neighbouring object within a millimetre by luck, which
no filter with a perception error of 9 mm may allow.
"""

from __future__ import annotations

import re
from collections import Counter
from typing import Any

import numpy as np

from dualbrain.control.control_loop import TickSnapshot
from dualbrain.core.storage.jsonl_log import JsonlLog
from experiments.engine.experiment import Options, Row, WorkUnit
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
"""Number of feasible tasks."""
MAX_FAILED_SHARE = 0.02
"""Largest share of them that the filter may make fail."""
MIN_LIFT = 0.05
"""Least height of a picked object above its initial position at the end [m]."""
PLACEMENT_ERROR_PATTERN = re.compile(r"([\d.]+) cm from the goal")


class Conservatism:
    """The filter does not prevent safe motions."""

    name = "conservatism"
    claim = (
        f"Of {N_FEASIBLE_TASKS} feasible tasks, the filter makes at most {MAX_FAILED_SHARE:.0%} fail; the time that it "
        "adds is reported."
    )

    def units(self, options: Options) -> list[WorkUnit]:
        """The first tasks of the fixed order, and one more for each infeasible one; start again until complete."""
        found = {
            row["key"]: row.get("feasible", True) for row in JsonlLog(options.folder / f"{self.name}.jsonl").latest()
        }
        units: list[WorkUnit] = []
        missing = N_FEASIBLE_TASKS
        for unit in (WorkUnit(_unit_key(parameters), parameters) for parameters in task_parameters()):
            if missing == 0:
                break
            units.append(unit)
            missing -= found.get(unit.key, True)
        return units

    def run(self, parameters: dict[str, Any]) -> Row:
        """Run without the filter, and with it if that was safe."""
        task = make_task(**parameters)
        off = _run_task(task, guard=False)
        feasible = _is_safe(off)
        on = _run_task(task, guard=True) if feasible else None
        return {**parameters, "feasible": feasible, "actions": task.actions, "off": off, "on": on}

    def summarize_row(self, row: Row) -> str:
        """Both outcomes."""
        if not row["feasible"]:
            return f"infeasible: {describe_outcome(row['off'])}"
        return f"off {row['off']['duration']:.1f} s; on {describe_outcome(row['on'])}"

    def report(self, rows: list[Row]) -> list[str]:
        """Share made to fail, added time, shares by family and kind, and every failure."""
        place = {key: index for index, key in enumerate(map(_unit_key, task_parameters()))}
        done = sorted((row for row in rows if row["key"] in place), key=lambda row: place[row["key"]])
        feasible = [row for row in done if row["feasible"]][:N_FEASIBLE_TASKS]
        failed = [row for row in feasible if not _is_safe(row["on"])]
        violations = dict(count_violations([row["on"] for row in feasible])) or "none"
        share = format_proportion(len(failed), len(feasible))
        lines = [
            f"Made to fail by the filter: **{share}** feasible tasks; required: at most {MAX_FAILED_SHARE:.0%}.",
            f"Tasks run: {len(done)}. Violations with the filter on: {violations}.",
            "",
            _added_time(feasible),
            "",
            *markdown_table(("", "tasks run", "feasible", "made to fail"), _breakdown(done, feasible, failed)),
        ]
        head = ("task", "reason", "depth", "binding rows", "violations")
        return lines + (markdown_table(head, map(_failure_row, failed)) if failed else [])


def _run_task(task: Task, *, guard: bool) -> Row:
    """The row of one run, with the binding rows at its end."""
    last: list[str] = []

    def watch(moment: TickSnapshot) -> None:
        if moment.result.binding_rows:
            last[:] = [f"{moment.nominal.phase}: {moment.result.explain()}"]

    run = run_contract(
        task.spec, task.actions, seed=task.spec.seed, settle_s=1.0, goal=task.goal, guard=guard, on_tick=watch
    )
    row = run_row(run)
    if row["valid"]:
        row["truth"] = _succeeded_on_truth(run, task)
        row["bound"] = "" if succeeded(row) else "".join(last)
    return row


def _succeeded_on_truth(run: ContractRun, task: Task) -> bool:
    """Success on ground truth: the goal, or the lifted object; a motion without object is judged by the robot alone."""
    if task.goal:
        return run.judgement.success
    return check_lift(run.plant, task.object_name)[1] > MIN_LIFT if task.kind == "pick" else True


def _is_safe(row: Row) -> bool:
    return row["valid"] and succeeded(row) and not row["violations"]


def _unit_key(parameters: dict[str, Any]) -> str:
    return f"{parameters['family']}:{parameters['seed']} {parameters['kind']}"


def _added_time(feasible: list[Row]) -> str:
    """The additional time of the same task with the filter, if both runs succeed."""
    durations = [(row["off"]["duration"], row["on"]["duration"]) for row in feasible if _is_safe(row["on"])]
    pairs = np.array(durations).reshape(-1, 2)
    if not len(pairs):
        return "No task has succeeded with and without the filter yet."
    added = pairs[:, 1] - pairs[:, 0]
    median, p90, most = np.median(added), np.quantile(added, 0.9), added.max()
    return (
        f"Added time over {len(added)} tasks that succeed with and without the filter: median {median:.2f} s, "
        f"p90 {p90:.2f} s, max {most:.2f} s; in total {added.sum() / pairs[:, 0].sum():.1%} of the time without filter."
    )


def _breakdown(done: list[Row], feasible: list[Row], failed: list[Row]) -> list[tuple[object, ...]]:
    lines: list[tuple[object, ...]] = []
    for field in ("family", "kind"):
        counts = [Counter(row[field] for row in some) for some in (done, feasible, failed)]
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
