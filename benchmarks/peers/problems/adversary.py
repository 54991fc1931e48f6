"""An adversarial nominal control, and a closed loop with acceleration limits for all filters."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable

import numpy as np

from benchmarks.peers.problems.problem import Problem, barrier_rows, clearances

Step = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]


def adversarial_nominal(
    problem: Problem, A: np.ndarray, h: np.ndarray, rng: np.random.Generator, *, toward: float, slowest: float
) -> np.ndarray:
    """Return a nominal control at a random speed between `slowest` and 1, relative to v_max.

    With probability `toward` it decreases one of the five smallest h, otherwise its direction is random.
    """
    corner = rng.choice([-1.0, 1.0], problem.n) * problem.v_max
    speed = rng.uniform(slowest, 1.0)
    if len(h) == 0 or rng.random() >= toward:
        return speed * corner
    row = A[np.argsort(h)[rng.integers(min(5, len(h)))]]
    return speed * np.where(np.abs(row) > 1e-3, -np.sign(row) * problem.v_max, 0.3 * corner)


def closed_loop(
    problem: Problem, step: Step, flag: Callable[[], str | None], *, steps: int, seed: int, hold: int = 150
) -> dict[str, object]:
    """Drive the plant v⁺ = clip(u, v ± a_max dt), q⁺ = q + dt v⁺ with `step` in the loop.

    If the filter raises or returns a control that is not finite, the plant brakes.
    """
    rng = np.random.default_rng(seed)
    q, v, u_nom = problem.home.copy(), np.zeros(problem.n), np.zeros(problem.n)
    h_min, failed, followed, flags = np.inf, 0, 0, Counter()
    change = problem.a_max * problem.period
    for k in range(steps):
        if k % hold == 0:
            A, _, h = barrier_rows(problem, q)
            u_nom = adversarial_nominal(problem, A, h, rng, toward=0.8, slowest=1.0)
        try:
            u = np.asarray(step(q, u_nom, v), float)
        except Exception as error:  # exceptions of a filter are counted, and the loop continues
            u = np.full(problem.n, np.nan)
            flags[type(error).__name__] += 1
        status = flag()
        if status is not None:
            flags[status] += 1
        finite = bool(np.all(np.isfinite(u)))
        failed += not finite
        command = u if finite else np.zeros(problem.n)
        velocity = np.clip(command, v - change, v + change)
        followed += bool(np.max(np.abs(velocity - command)) < 1e-6)
        v = velocity
        q = q + problem.period * v
        h_min = min(h_min, float(np.min(clearances(problem, q))))
    return {
        "h_min": h_min,
        "steps": steps,
        "failed": failed,
        "followed_share": followed / steps,
        "flags": dict(flags),
    }
