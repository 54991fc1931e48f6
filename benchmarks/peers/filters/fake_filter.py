"""A filter for tests: clips u_nom to the box, after a delay."""

from __future__ import annotations

import time

import numpy as np

from benchmarks.peers.problems.problem import Problem, control_bounds

VERSIONS = ("numpy",)


class Filter:
    """Ignores obstacles; sleeps for `delay` [s] in every step."""

    margin = 0.0

    def __init__(
        self, problem: Problem, *, delay: float = 0.0, alpha: float | None = None, limited: bool = False
    ) -> None:
        del alpha, limited
        self.problem, self.delay = problem, delay

    def step(self, q: np.ndarray, u_nom: np.ndarray, v: np.ndarray | None = None) -> np.ndarray:
        """Return the nominal control, clipped to the box."""
        del v
        if self.delay:
            time.sleep(self.delay)
        return np.clip(u_nom, *control_bounds(self.problem, q))

    def step_statistics(self) -> dict[str, object]:
        """Return the number of rows of a step."""
        return {"rows_in_qp": 0}

    def reported_status(self) -> None:
        """Report no status."""

    def reset(self) -> None:
        """Do nothing: the filter has no state."""
