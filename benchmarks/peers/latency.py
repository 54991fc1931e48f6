"""Latency, first call and deviation of all contestants at one size: alternating blocks on the same states."""

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
"""[rad/s] beyond which a control counts as changed."""


@dataclass(frozen=True, slots=True)
class MeasurementBudget:
    """How long to measure: recorded steps, rounds, steps of a block, most seconds of a block, states for deviation.

    Who has spent `contestant_s` sits the remaining rounds out. `at_once` contestants are prepared together, as
    compiling takes long; then each runs alone, in turn.
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


def measure(
    setting: str, n: int, contestants: Sequence[BenchmarkedFilter], effort: MeasurementBudget
) -> dict[str, Any]:
    """One size of one setting: rows, first calls, deviations, who could not take part."""
    problem = scenes.rows_problem(n) if setting == "rows" else scenes.primitives_problem(n)
    states, nominals, changed = scenes.record_states(problem, effort.steps if setting == "rows" else effort.steps // 3)
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
        with ThreadPoolExecutor(effort.parallel_starts) as pool:
            started = pool.map(lambda contestant: _start_filter(contestant, files, effort, result), contestants)
            children = [child for child in started if child is not None]
        try:
            result["rows"] = _latency_rows(_measure_blocks(children, len(states), effort, result), children, result)
            if setting == "rows":
                at = np.linspace(0, len(states) - 1, effort.deviation_states).astype(int)
                for child in children:
                    if not (child.entry.is_own and child.entry.name != OWN_NAME):
                        result["deviation"].append(_deviation(child, problem, states, nominals, at))
        finally:
            for child in children:
                child.close()
    result["load_after"] = os.getloadavg()[0]
    return result


def _start_filter(
    contestant: BenchmarkedFilter, files: dict[str, str], effort: MeasurementBudget, result: dict[str, Any]
) -> FilterProcess | None:
    """Its process, prepared, with its first step taken; None, and the reason noted, where that cannot be."""
    name = contestant.name
    try:
        child = FilterProcess(contestant)
    except FilterUnavailableError as why:
        result["refused"].append({"peer": name, "n": result["n"], "setting": result["setting"], "why": str(why)})
        return None
    try:
        result["versions"][name] = child.request("versions")["versions"]
        first = child.request("prepare", effort.prepare_timeout_s, options=contestant.options, **files)
    except FilterUnavailableError as why:
        result["refused"].append({"peer": name, "n": result["n"], "setting": result["setting"], "why": str(why)})
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
    children: list[FilterProcess], steps: int, effort: MeasurementBudget, result: dict[str, Any]
) -> dict[str, list[int]]:
    """Times [ns] of every contestant, block by block in turn; slow ones take shorter blocks of the same states."""
    times: dict[str, list[int]] = {child.entry.name: [] for child in children}
    lengths = {name: 1 for name in times}
    failed, spent = dict.fromkeys(times, 0), dict.fromkeys(times, 0.0)
    busy: dict[str, list[float]] = {name: [] for name in times}
    for turn in range(-1, effort.rounds):
        start = WARM_UP_STEPS + max(0, turn) * effort.block % max(1, steps - effort.block - WARM_UP_STEPS)
        shift = max(0, turn) % len(children) if children else 0
        for child in [*children[shift:], *children[:shift]]:
            name = child.entry.name
            if spent[name] > effort.filter_s:
                continue
            begin = time.monotonic()
            warm = 0 if turn < 0 or lengths[name] < WARM_UP_STEPS else WARM_UP_STEPS
            answer = child.request("block", start=start, stop=start + lengths[name], warm=warm)
            if turn < 0:  # finds out how long a block may be
                pace = 1e-9 * float(np.median(answer["ns"]))
                lengths[name] = int(np.clip(effort.block_s / max(pace, 1e-9), 1, effort.block))
            else:
                spent[name] += time.monotonic() - begin
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
    """Largest and median |u − u*|, worst row, and how often u was changed although nothing had to be."""
    answer = child.request("answers", at=at.tolist())
    away, own, worst, idle, touched, none = [], [], [], 0, 0, 0
    for k, one in zip(at, answer["answers"], strict=True):
        if one["u"] is None or not np.all(np.isfinite(one["u"])):
            none += 1
            continue
        u, u_nom = np.array(one["u"]), nominals[k]
        A, b, _ = barrier_rows(problem, states[k], margin=answer["margin"])
        best = exact_optimum(A, b, *control_bounds(problem, states[k]), u_nom)
        away.append(float(np.max(np.abs(u - best))))
        A, b, _ = barrier_rows(problem, states[k])
        worst.append(float(np.max(b - A @ u)))
        if np.max(np.abs(best - u_nom)) < 1e-9:
            idle += 1
            touched += bool(np.max(np.abs(u - u_nom)) > CHANGE_TOLERANCE)
        if "stated" in one:
            A, b, lower, upper = (np.array(x) for x in one["stated"])
            own.append(float(np.max(np.abs(u - exact_optimum(A.reshape(len(b), -1), b, lower, upper, u_nom)))))
    return {
        "peer": child.entry.name,
        "n": problem.n_pairs,
        "states": len(at),
        "no_answer": none,
        "max": max(away, default=None),
        "median": float(np.median(away)) if away else None,
        "max_on_own_rows": max(own, default=None),
        "worst_row_violation": max(worst, default=None),
        "nothing_to_do": idle,
        "changed_all_the_same": touched,
    }
