"""What contestants do where there is no answer, and how near they let an adversary come under acceleration limits."""

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


@dataclasses.dataclass(frozen=True, slots=True)
class Case:
    """A state without an answer: `feasible` is the oracle's word on the rows, None where there are no rows to judge."""

    name: str
    description: str
    q: list[float]
    u_nom: list[float]
    feasible: bool | None


def infeasible_cases() -> tuple[Problem, list[Case]]:
    """The hand between two balls that both reach 1 cm into the same sphere, and states that are no states."""
    empty = scenes.arm_problem(scenes.thin_body(), whole=False)
    middle = centres(empty, empty.home)[-1]
    off = np.array([0.0, empty.sphere_radius[-1] + 0.04 - 0.01, 0.0])
    problem = scenes.with_obstacles(
        empty, [(SPHERE, middle + side * off, np.eye(3), np.zeros(3), 0.04) for side in (-1.0, 1.0)]
    )
    q, u_nom = problem.home, 0.2 * problem.v_max
    lost, outside, unasked = q.copy(), q.copy(), u_nom.copy()
    lost[2] = unasked[2] = np.nan
    outside[3] = problem.q_upper[3] + 0.8
    cases = [
        ("contradiction", "two balls press on the same sphere from both sides: n'Ju ≥ a and −n'Ju ≥ a", q, u_nom),
        ("outside", "joint 4 stands 0.8 rad beyond its limit: the way back asks for more than v_max", outside, u_nom),
        ("NaN state", "q₃ is NaN", lost, u_nom),
        ("NaN nominal", "u_nom₃ is NaN", q, unasked),
    ]
    return problem, [
        Case(name, what, state.tolist(), wish.tolist(), _is_feasible(problem, state, wish))
        for name, what, state, wish in cases
    ]


def _is_feasible(problem: Problem, q: np.ndarray, u_nom: np.ndarray) -> bool | None:
    if not (np.all(np.isfinite(q)) and np.all(np.isfinite(u_nom))):
        return None
    A, b, _ = barrier_rows(problem, q)
    lower, upper = control_bounds(problem, q)
    return bool(np.all(lower <= upper) and np.all(np.isfinite(exact_optimum(A, b, lower, upper, u_nom))))


def measure_infeasible(contestants: Sequence[BenchmarkedFilter]) -> list[dict[str, Any]]:
    """One record for each contestant and case: what came back, and whether anything said so."""
    problem, cases = infeasible_cases()

    def ask(contestant: BenchmarkedFilter, child: FilterProcess) -> list[dict[str, Any]]:
        return [
            _verdict(contestant, problem, case, child.request("once", q=case.q, u_nom=case.u_nom)) for case in cases
        ]

    return [one for found in _for_each_filter(contestants, problem, ask) for one in found]


def _verdict(contestant: BenchmarkedFilter, problem: Problem, case: Case, answer: dict[str, Any]) -> dict[str, Any]:
    u = None if answer["u"] is None else np.array(answer["u"])
    finite = u is not None and bool(np.all(np.isfinite(u)))
    said = answer["flag"] or "silent" if answer["error"] is None else f"raised {answer['error']}"
    return {
        "peer": contestant.name,
        "case": case.name,
        "what": case.description,
        "feasible": case.feasible,
        "said": said,
        "finite": finite,
        "u_max": float(np.max(np.abs(u))) if finite else None,
        "within_v_max": bool(np.all(np.abs(u) <= problem.v_max + 1e-6)) if finite else None,
        "is_nominal": bool(np.allclose(u, case.u_nom, atol=1e-3)) if finite else None,
    }


def measure_clearance(
    contestants: Sequence[BenchmarkedFilter], *, steps: int = 3000, seeds: int = 2
) -> list[dict[str, Any]]:
    """Least true h [m] of the closed loop with Panda's a_max, for every contestant at its gains."""
    problem = scenes.rows_problem(N_PAIRS)
    chosen = [
        dataclasses.replace(c, options=c.options | {"limited": True} | ({} if gain is None else {"alpha": gain}))
        for c in contestants
        for gain in c.gains
    ]

    def ask(contestant: BenchmarkedFilter, child: FilterProcess) -> dict[str, Any]:
        runs = [child.request("loop", 600.0, steps=steps, seed=seed) for seed in range(seeds)]
        flags: Counter[str] = Counter()
        for run in runs:
            flags.update(run["flags"])
        found = {
            "peer": contestant.name,
            "alpha": contestant.options.get("alpha", problem.alpha),
            "h_min": min(run["h_min"] for run in runs),
            "steps": steps * seeds,
            "no_answer": sum(run["failed"] for run in runs),
            "followed_share": float(np.mean([run["followed_share"] for run in runs])),
            "flags": dict(flags),
        }
        print(f"  {contestant.name}, α {found['alpha']:.2f}: {1e3 * found['h_min']:.2f} mm", file=sys.stderr)
        return found

    return _for_each_filter(chosen, problem, ask)


T = TypeVar("T")


def _for_each_filter(
    contestants: Sequence[BenchmarkedFilter], problem: Problem, ask: Callable[[BenchmarkedFilter, FilterProcess], T]
) -> list[T]:
    """What `ask` finds with everybody who can take this problem; nothing here is timed, so that several run at once."""
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(MAX_PARALLEL) as pool:
        path = str(Path(folder) / "problem.npz")
        problem.save(path)

        def meet(contestant: BenchmarkedFilter) -> T | None:
            try:
                child = FilterProcess(contestant)
            except FilterUnavailableError as why:
                print(f"  {contestant.name}: {why}", file=sys.stderr)
                return None
            try:
                child.request("prepare", problem=path, options=contestant.options)
                return ask(contestant, child)
            except FilterUnavailableError as why:
                print(f"  {contestant.name}: {why}", file=sys.stderr)
                return None
            finally:
                child.close()

        return [found for found in pool.map(meet, contestants) if found is not None]
