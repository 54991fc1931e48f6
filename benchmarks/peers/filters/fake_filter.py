"""A contestant for tests: clips u_nom to the box, as slowly as asked."""

from __future__ import annotations

import time

import numpy as np

from benchmarks.peers.problems.problem import Problem, control_bounds

VERSIONS = ("numpy",)


class Filter:
    """Knows nothing of obstacles; `nap` [s] is slept in every step."""

    margin = 0.0

    def __init__(
        self, problem: Problem, *, nap: float = 0.0, alpha: float | None = None, limited: bool = False
    ) -> None:
        del alpha, limited
        self.problem, self.nap = problem, nap

    def step(self, q: np.ndarray, u_nom: np.ndarray, v: np.ndarray | None = None) -> np.ndarray:
        """The nominal within the box."""
        del v
        if self.nap:
            time.sleep(self.nap)
        return np.clip(u_nom, *control_bounds(self.problem, q))

    def step_statistics(self) -> dict[str, object]:
        """What a step looks at."""
        return {"rows_in_qp": 0}

    def reported_status(self) -> None:
        """Says nothing."""

    def reset(self) -> None:
        """Nothing is remembered."""
