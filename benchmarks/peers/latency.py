"""Latency, first call and deviation of all filters at one size, in alternating blocks on the same states."""

from __future__ import annotations

import os
import sys
import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.peers.benchmarked_filters import OWN_NAME, BenchmarkedFilter
from benchmarks.peers.problems import scenes
from benchmarks.peers.problems.problem import Problem, barrier_rows, control_bounds
from benchmarks.peers.problems.qp_oracle import exact_optimum
from benchmarks.peers.processes.filter_process import FilterProcess, FilterUnavailableError

WARM_UP_STEPS = 5
CHANGE_TOLERANCE = 1e-4
"""Smallest deviation [rad/s] at which a control counts as changed."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MeasurementBudget:
    """Extent of a measurement: recorded steps, rounds, steps and seconds per block, states for the deviation.

    A filter that has run for `filter_s` [s] skips the remaining rounds. `parallel_starts` filters are prepared
    concurrently, because compilation takes long; the measurement itself runs one filter at a time.
    """

    steps: int = 1200
    rounds: int = 20
    block: int = 40
    block_s: float = 0.25
    deviation_states: int = 40
    filter_s: float = 20.0
    prepare_timeout_s: float = 200.0
    parallel_starts: int = 3


QUICK_BUDGET = MeasurementBudget(steps=60, rounds=2, block=10, deviation_states=3, prepare_timeout_s=20.0)


def measure(setting: str, n: int, entries: Sequence[BenchmarkedFilter], budget: MeasurementBudget) -> dict[str, Any]:
    """Measure one size of a setting: rows, first calls, deviations, and the filters that could not run."""
    problem = scenes.rows_problem(n) if setting == "rows" else scenes.primitives_problem(n)
    states, nominals, changed = scenes.record_states(problem, budget.steps if setting == "rows" else budget.steps // 3)
    result: dict[str, Any] = {
        "setting": setting,
        "n": n,
        "pairs": problem.n_pairs,
        "changed_share": round(changed, 3),
        "rows": [],
        "first_call": [],
        "deviation": [],
        "refused": [],
        "versions": {},
        "load_before": os.getloadavg()[0],
    }
    with tempfile.TemporaryDirectory() as folder:
        files = {"problem": str(Path(folder) / "problem.npz"), "states": str(Path(folder) / "states.npz")}
        problem.save(files["problem"])
        np.savez(files["states"], states=states, nominals=nominals)
        with ThreadPoolExecutor(budget.parallel_starts) as pool:
            started = pool.map(lambda entry: _start_filter(entry, files, budget, result), entries)
            children = [child for child in started if child is not None]
        try:
            result["rows"] = _latency_rows(_measure_blocks(children, len(states), budget, result), children, result)
            if setting == "rows":
                at = np.linspace(0, len(states) - 1, budget.deviation_states).astype(int)
                for child in children:
                    if not (child.entry.is_own and child.entry.name != OWN_NAME):
                        result["deviation"].append(_deviation(child, problem, states, nominals, at))
        finally:
            for child in children:
                child.close()
    result["load_after"] = os.getloadavg()[0]
    return result


def _start_filter(
    entry: BenchmarkedFilter, files: dict[str, str], budget: MeasurementBudget, result: dict[str, Any]
) -> FilterProcess | None:
    """Return the prepared process of a filter after its first step; None, with the reason in `result`, on failure."""
    name = entry.name
    try:
        child = FilterProcess(entry)
    except FilterUnavailableError as error:
        result["refused"].append({"peer": name, "n": result["n"], "setting": result["setting"], "why": str(error)})
        return None
    try:
        result["versions"][name] = child.request("versions")["versions"]
        first = child.request("prepare", budget.prepare_timeout_s, options=entry.options, **files)
    except FilterUnavailableError as error:
        result["refused"].append({"peer": name, "n": result["n"], "setting": result["setting"], "why": str(error)})
        child.close()
        return None
    print(f"  {name}: first call after {first['prepare_s'] + first['first_s']:.2f} s", file=sys.stderr)
    result["first_call"].append(
        {
            "peer": name,
            "setting": result["setting"],
            "n": result["n"],
            "import_s": child.import_s,
            "prepare_s": first["prepare_s"],
            "first_s": first["first_s"],
            "processor_s": first["processor_s"],
            "error": first["error"],
        }
    )
    return child


def _measure_blocks(
    children: list[FilterProcess], steps: int, budget: MeasurementBudget, result: dict[str, Any]
) -> dict[str, list[int]]:
    """Return step times of every filter [ns], measured in alternating blocks; slow filters get shorter blocks."""
    times: dict[str, list[int]] = {child.entry.name: [] for child in children}
    lengths = {name: 1 for name in times}
    failed, spent = dict.fromkeys(times, 0), dict.fromkeys(times, 0.0)
    busy: dict[str, list[float]] = {name: [] for name in times}
    for turn in range(-1, budget.rounds):
        start = WARM_UP_STEPS + max(0, turn) * budget.block % max(1, steps - budget.block - WARM_UP_STEPS)
        shift = max(0, turn) % len(children) if children else 0
        for child in [*children[shift:], *children[:shift]]:
            name = child.entry.name
            if spent[name] > budget.filter_s:
                continue
            start_time = time.monotonic()
            n_warm_up = 0 if turn < 0 or lengths[name] < WARM_UP_STEPS else WARM_UP_STEPS
            answer = child.request("block", start=start, stop=start + lengths[name], warm=n_warm_up)
            if turn < 0:  # this turn determines the length of a block
                step_s = 1e-9 * float(np.median(answer["ns"]))
                lengths[name] = int(np.clip(budget.block_s / max(step_s, 1e-9), 1, budget.block))
            else:
                spent[name] += time.monotonic() - start_time
                times[name] += answer["ns"]
                busy[name].append(answer["processor_ns"])
                failed[name] += answer["failed"]
    result["failed"] = failed
    result["processor_us"] = {name: 1e-3 * float(np.median(blocks)) for name, blocks in busy.items()}
    return times


def _latency_rows(
    times: dict[str, list[int]], children: list[FilterProcess], result: dict[str, Any]
) -> list[dict[str, Any]]:
    medians = {name: float(np.median(ns)) for name, ns in times.items()}
    own = medians.get(OWN_NAME)
    table = []
    for child in children:
        c, ns = child.entry, times[child.entry.name]
        table.append(
            {
                "peer": c.name,
                "setting": result["setting"],
                "n": result["n"],
                "median_us": 1e-3 * medians[c.name],
                "p99_us": 1e-3 * float(np.percentile(ns, 99)),
                "ratio": None if own is None else medians[c.name] / own,
                "processor_us": result["processor_us"][c.name],
                "samples": len(ns),
                "failed": result["failed"][c.name],
                "same_problem": c.same_rows,
                "shipped": c.is_default,
                "ours": c.is_own,
                "evaluated": child.request("answers", at=[5])["evaluated"],
            }
        )
    return table


def _deviation(
    child: FilterProcess, problem: Problem, states: np.ndarray, nominals: np.ndarray, at: np.ndarray
) -> dict[str, Any]:
    """Return the largest and median |u − u*|, the worst row, and the number of unnecessary changes of u."""
    answer = child.request("answers", at=at.tolist())
    deviations, own, worst, n_safe, n_changed, n_missing = [], [], [], 0, 0, 0
    for k, one in zip(at, answer["answers"], strict=True):
        if one["u"] is None or not np.all(np.isfinite(one["u"])):
            n_missing += 1
            continue
        u, u_nom = np.array(one["u"]), nominals[k]
        A, b, _ = barrier_rows(problem, states[k], margin=answer["margin"])
        best = exact_optimum(A, b, *control_bounds(problem, states[k]), u_nom)
        deviations.append(float(np.max(np.abs(u - best))))
        A, b, _ = barrier_rows(problem, states[k])
        worst.append(float(np.max(b - A @ u)))
        if np.max(np.abs(best - u_nom)) < 1e-9:
            n_safe += 1
            n_changed += bool(np.max(np.abs(u - u_nom)) > CHANGE_TOLERANCE)
        if "stated" in one:
            A, b, lower, upper = (np.array(x) for x in one["stated"])
            own.append(float(np.max(np.abs(u - exact_optimum(A.reshape(len(b), -1), b, lower, upper, u_nom)))))
    return {
        "peer": child.entry.name,
        "n": problem.n_pairs,
        "states": len(at),
        "no_answer": n_missing,
        "max": max(deviations, default=None),
        "median": float(np.median(deviations)) if deviations else None,
        "max_on_own_rows": max(own, default=None),
        "worst_row_violation": max(worst, default=None),
        "nothing_to_do": n_safe,
        "changed_all_the_same": n_changed,
    }
