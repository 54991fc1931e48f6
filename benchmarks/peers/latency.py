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

from benchmarks.peers.benchmarked_filters import OWN, Contestant
from benchmarks.peers.problems import scenes
from benchmarks.peers.problems.problem import Problem, box, rows
from benchmarks.peers.problems.qp_oracle import optimum
from benchmarks.peers.processes.filter_process import Child, Refused

WARM = 5
TOLERANCE = 1e-4
"""[rad/s] beyond which a control counts as changed."""


@dataclass(frozen=True, slots=True)
class Effort:
    """How long to measure: recorded steps, rounds, steps of a block, most seconds of a block, states for deviation.

    Who has spent `contestant_s` sits the remaining rounds out. `at_once` contestants are prepared together, as
    compiling takes long; then each runs alone, in turn.
    """

    steps: int = 1200
    rounds: int = 20
    block: int = 40
    block_s: float = 0.25
    checked: int = 40
    contestant_s: float = 20.0
    patience_s: float = 200.0
    at_once: int = 3


QUICK = Effort(steps=60, rounds=2, block=10, checked=3, patience_s=20.0)


def measure(setting: str, n: int, contestants: Sequence[Contestant], effort: Effort) -> dict[str, Any]:
    """One size of one setting: rows, first calls, deviations, who could not take part."""
    problem = scenes.rows_problem(n) if setting == "rows" else scenes.primitives_problem(n)
    states, nominals, changed = scenes.record(problem, effort.steps if setting == "rows" else effort.steps // 3)
    result: dict[str, Any] = {
        "setting": setting, "n": n, "pairs": problem.n_pairs, "changed_share": round(changed, 3), "rows": [],
        "first_call": [], "deviation": [], "refused": [], "versions": {}, "load_before": os.getloadavg()[0],
    }  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        files = {"problem": str(Path(folder) / "problem.npz"), "states": str(Path(folder) / "states.npz")}
        problem.save(files["problem"])
        np.savez(files["states"], states=states, nominals=nominals)
        with ThreadPoolExecutor(effort.at_once) as pool:
            started = pool.map(lambda contestant: _start(contestant, files, effort, result), contestants)
            children = [child for child in started if child is not None]
        try:
            result["rows"] = _rows(_alternate(children, len(states), effort, result), children, result)
            if setting == "rows":
                at = np.linspace(0, len(states) - 1, effort.checked).astype(int)
                for child in children:
                    if not (child.contestant.ours and child.contestant.name != OWN):
                        result["deviation"].append(_deviation(child, problem, states, nominals, at))
        finally:
            for child in children:
                child.close()
    result["load_after"] = os.getloadavg()[0]
    return result


def _start(contestant: Contestant, files: dict[str, str], effort: Effort, result: dict[str, Any]) -> Child | None:
    """Its process, prepared, with its first step taken; None, and the reason noted, where that cannot be."""
    name = contestant.name
    try:
        child = Child(contestant)
    except Refused as why:
        result["refused"].append({"peer": name, "n": result["n"], "setting": result["setting"], "why": str(why)})
        return None
    try:
        result["versions"][name] = child.ask("versions")["versions"]
        first = child.ask("prepare", effort.patience_s, options=contestant.options, **files)
    except Refused as why:
        result["refused"].append({"peer": name, "n": result["n"], "setting": result["setting"], "why": str(why)})
        child.close()
        return None
    print(f"  {name}: first call after {first['prepare_s'] + first['first_s']:.2f} s", file=sys.stderr)
    result["first_call"].append({
        "peer": name, "setting": result["setting"], "n": result["n"], "import_s": child.import_s,
        "prepare_s": first["prepare_s"], "first_s": first["first_s"], "processor_s": first["processor_s"],
        "error": first["error"],
    })  # fmt: skip
    return child


def _alternate(children: list[Child], steps: int, effort: Effort, result: dict[str, Any]) -> dict[str, list[int]]:
    """Times [ns] of every contestant, block by block in turn; slow ones take shorter blocks of the same states."""
    times: dict[str, list[int]] = {child.contestant.name: [] for child in children}
    lengths = {name: 1 for name in times}
    failed, spent = dict.fromkeys(times, 0), dict.fromkeys(times, 0.0)
    busy: dict[str, list[float]] = {name: [] for name in times}
    for turn in range(-1, effort.rounds):
        start = WARM + max(0, turn) * effort.block % max(1, steps - effort.block - WARM)
        shift = max(0, turn) % len(children) if children else 0
        for child in [*children[shift:], *children[:shift]]:
            name = child.contestant.name
            if spent[name] > effort.contestant_s:
                continue
            begin = time.monotonic()
            warm = 0 if turn < 0 or lengths[name] < WARM else WARM
            answer = child.ask("block", start=start, stop=start + lengths[name], warm=warm)
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


def _rows(times: dict[str, list[int]], children: list[Child], result: dict[str, Any]) -> list[dict[str, Any]]:
    medians = {name: float(np.median(ns)) for name, ns in times.items()}
    own = medians.get(OWN)
    table = []
    for child in children:
        c, ns = child.contestant, times[child.contestant.name]
        table.append({
            "peer": c.name, "setting": result["setting"], "n": result["n"], "median_us": 1e-3 * medians[c.name],
            "p99_us": 1e-3 * float(np.percentile(ns, 99)), "ratio": None if own is None else medians[c.name] / own,
            "processor_us": result["processor_us"][c.name],
            "samples": len(ns), "failed": result["failed"][c.name], "same_problem": c.exact, "shipped": c.shipped,
            "ours": c.ours, "evaluated": child.ask("answers", at=[5])["evaluated"],
        })  # fmt: skip
    return table


def _deviation(
    child: Child, problem: Problem, states: np.ndarray, nominals: np.ndarray, at: np.ndarray
) -> dict[str, Any]:
    """Largest and median |u − u*|, worst row, and how often u was changed although nothing had to be."""
    answer = child.ask("answers", at=at.tolist())
    away, own, worst, idle, touched, none = [], [], [], 0, 0, 0
    for k, one in zip(at, answer["answers"], strict=True):
        if one["u"] is None or not np.all(np.isfinite(one["u"])):
            none += 1
            continue
        u, u_nom = np.array(one["u"]), nominals[k]
        A, b, _ = rows(problem, states[k], margin=answer["margin"])
        best = optimum(A, b, *box(problem, states[k]), u_nom)
        away.append(float(np.max(np.abs(u - best))))
        A, b, _ = rows(problem, states[k])
        worst.append(float(np.max(b - A @ u)))
        if np.max(np.abs(best - u_nom)) < 1e-9:
            idle += 1
            touched += bool(np.max(np.abs(u - u_nom)) > TOLERANCE)
        if "stated" in one:
            A, b, lower, upper = (np.array(x) for x in one["stated"])
            own.append(float(np.max(np.abs(u - optimum(A.reshape(len(b), -1), b, lower, upper, u_nom)))))
    return {
        "peer": child.contestant.name, "n": problem.n_pairs, "states": len(at), "no_answer": none,
        "max": max(away, default=None), "median": float(np.median(away)) if away else None,
        "max_on_own_rows": max(own, default=None), "worst_row_violation": max(worst, default=None),
        "nothing_to_do": idle, "changed_all_the_same": touched,
    }  # fmt: skip
