"""Behaviour of the filters without a feasible control, and clearance in an adversarial closed loop."""

from __future__ import annotations

import dataclasses
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from benchmarks.peers.benchmarked_filters import BenchmarkedFilter
from benchmarks.peers.problems import scenes
from benchmarks.peers.problems.problem import SPHERE, Problem, barrier_rows, centres, control_bounds
from benchmarks.peers.problems.qp_oracle import exact_optimum
from benchmarks.peers.processes.filter_process import FilterProcess, FilterUnavailableError

N_PAIRS = 50
MAX_PARALLEL = 3


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Case:
    """An invalid state or nominal control; `feasible`: whether the oracle finds a solution (None: no finite rows)."""

    name: str
    description: str
    q: list[float]
    u_nom: list[float]
    feasible: bool | None


def infeasible_cases() -> tuple[Problem, list[Case]]:
    """Return a problem with two spheres that overlap a robot sphere by 1 cm from both sides, and the invalid cases."""
    empty = scenes.arm_problem(scenes.thin_body(), whole=False)
    middle = centres(empty, empty.home)[-1]
    offset = np.array([0.0, empty.sphere_radius[-1] + 0.04 - 0.01, 0.0])
    problem = scenes.with_obstacles(
        empty, [(SPHERE, middle + side * offset, np.eye(3), np.zeros(3), 0.04) for side in (-1.0, 1.0)]
    )
    q, u_nom = problem.home, 0.2 * problem.v_max
    nan_state, outside, nan_nominal = q.copy(), q.copy(), u_nom.copy()
    nan_state[2] = nan_nominal[2] = np.nan
    outside[3] = problem.q_upper[3] + 0.8
    cases = [
        (
            "contradiction",
            "two obstacles overlap the same robot sphere from both sides: n'Ju ≥ a and −n'Ju ≥ a",
            q,
            u_nom,
        ),
        ("outside", "joint 4 is 0.8 rad beyond its limit: the return requires more than v_max", outside, u_nom),
        ("NaN state", "q₃ is NaN", nan_state, u_nom),
        ("NaN nominal", "u_nom₃ is NaN", q, nan_nominal),
    ]
    return problem, [
        Case(
            name=name,
            description=description,
            q=state.tolist(),
            u_nom=nominal.tolist(),
            feasible=_is_feasible(problem, state, nominal),
        )
        for name, description, state, nominal in cases
    ]


def _is_feasible(problem: Problem, q: np.ndarray, u_nom: np.ndarray) -> bool | None:
    if not (np.all(np.isfinite(q)) and np.all(np.isfinite(u_nom))):
        return None
    A, b, _ = barrier_rows(problem, q)
    lower, upper = control_bounds(problem, q)
    return bool(np.all(lower <= upper) and np.all(np.isfinite(exact_optimum(A, b, lower, upper, u_nom))))


def measure_infeasible(entries: Sequence[BenchmarkedFilter]) -> list[dict[str, Any]]:
    """Return a record per filter and case: its answer, and whether it reports the failure."""
    problem, cases = infeasible_cases()

    def measure(entry: BenchmarkedFilter, child: FilterProcess) -> list[dict[str, Any]]:
        return [_verdict(entry, problem, case, child.request("once", q=case.q, u_nom=case.u_nom)) for case in cases]

    return [one for found in _for_each_filter(entries, problem, measure) for one in found]


def _verdict(entry: BenchmarkedFilter, problem: Problem, case: Case, answer: dict[str, Any]) -> dict[str, Any]:
    u = None if answer["u"] is None else np.array(answer["u"])
    finite = u is not None and bool(np.all(np.isfinite(u)))
    report = answer["flag"] or "silent" if answer["error"] is None else f"raised {answer['error']}"
    return {
        "peer": entry.name,
        "case": case.name,
        "what": case.description,
        "feasible": case.feasible,
        "report": report,
        "finite": finite,
        "u_max": float(np.max(np.abs(u))) if finite else None,
        "within_v_max": bool(np.all(np.abs(u) <= problem.v_max + 1e-6)) if finite else None,
        "is_nominal": bool(np.allclose(u, case.u_nom, atol=1e-3)) if finite else None,
    }


def measure_clearance(
    entries: Sequence[BenchmarkedFilter], *, steps: int = 3000, seeds: int = 2
) -> list[dict[str, Any]]:
    """Return the smallest true h of the closed loop with the a_max of the Panda [m], per filter and gain."""
    problem = scenes.rows_problem(N_PAIRS)
    chosen = [
        dataclasses.replace(c, options=c.options | {"limited": True} | ({} if gain is None else {"alpha": gain}))
        for c in entries
        for gain in c.gains
    ]

    def measure(entry: BenchmarkedFilter, child: FilterProcess) -> dict[str, Any]:
        runs = [child.request("loop", 600.0, steps=steps, seed=seed) for seed in range(seeds)]
        flags: Counter[str] = Counter()
        for run in runs:
            flags.update(run["flags"])
        found = {
            "peer": entry.name,
            "alpha": entry.options.get("alpha", problem.alpha),
            "h_min": min(run["h_min"] for run in runs),
            "steps": steps * seeds,
            "no_answer": sum(run["failed"] for run in runs),
            "followed_share": float(np.mean([run["followed_share"] for run in runs])),
            "flags": dict(flags),
        }
        print(f"  {entry.name}, α {found['alpha']:.2f}: {1e3 * found['h_min']:.2f} mm", file=sys.stderr)
        return found

    return _for_each_filter(chosen, problem, measure)


T = TypeVar("T")


def _for_each_filter(
    entries: Sequence[BenchmarkedFilter], problem: Problem, measure: Callable[[BenchmarkedFilter, FilterProcess], T]
) -> list[T]:
    """Return the results of `measure` for all filters that can solve the problem; MAX_PARALLEL of them run at once."""
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(MAX_PARALLEL) as pool:
        path = str(Path(folder) / "problem.npz")
        problem.save(path)

        def run(entry: BenchmarkedFilter) -> T | None:
            try:
                child = FilterProcess(entry)
            except FilterUnavailableError as error:
                print(f"  {entry.name}: {error}", file=sys.stderr)
                return None
            try:
                child.request("prepare", problem=path, options=entry.options)
                return measure(entry, child)
            except FilterUnavailableError as error:
                print(f"  {entry.name}: {error}", file=sys.stderr)
                return None
            finally:
                child.close()

        return [found for found in pool.map(run, entries) if found is not None]
