"""A nominal that wants to collide, and the closed loop under acceleration limits in which every contestant meets it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable

import numpy as np

from benchmarks.peers.problems.problem import Problem, barrier_rows, clearances

Step = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]


def adversarial_nominal(
    problem: Problem, A: np.ndarray, h: np.ndarray, rng: np.random.Generator, *, toward: float, slowest: float
) -> np.ndarray:
    """`slowest` to all of full speed, with probability `toward` down the gradient of one of the five smallest h."""
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

    Where a contestant raises or returns something that is not finite, the plant brakes: what a careful user would do.
    """
    rng = np.random.default_rng(seed)
    q, v, u_nom = problem.home.copy(), np.zeros(problem.n), np.zeros(problem.n)
    least, failed, followed, flags = np.inf, 0, 0, Counter()
    change = problem.a_max * problem.period
    for k in range(steps):
        if k % hold == 0:
            A, _, h = barrier_rows(problem, q)
            u_nom = adversarial_nominal(problem, A, h, rng, toward=0.8, slowest=1.0)
        try:
            u = np.asarray(step(q, u_nom, v), float)
        except Exception as error:  # whatever a peer raises is counted, and the loop goes on
            u = np.full(problem.n, np.nan)
            flags[type(error).__name__] += 1
        word = flag()
        if word is not None:
            flags[word] += 1
        finite = bool(np.all(np.isfinite(u)))
        failed += not finite
        wanted = u if finite else np.zeros(problem.n)
        moved = np.clip(wanted, v - change, v + change)
        followed += bool(np.max(np.abs(moved - wanted)) < 1e-6)
        v = moved
        q = q + problem.period * v
        least = min(least, float(np.min(clearances(problem, q))))
    return {
        "h_min": least,
        "steps": steps,
        "failed": failed,
        "followed_share": followed / steps,
        "flags": dict(flags),
    }
