"""The exact optimum in float64 by two independent solvers: DAQP, checked against PIQP."""

from __future__ import annotations

import daqp
import numpy as np

UNBOUNDED = 1e30


def exact_optimum(A: np.ndarray, b: np.ndarray, lower: np.ndarray, upper: np.ndarray, u_nom: np.ndarray) -> np.ndarray:
    """Return u (n,) of min ½‖u − u_nom‖² s.t. A u ≥ b, lower ≤ u ≤ upper by DAQP; NaN if infeasible."""
    n = len(u_nom)
    above = np.concatenate([upper, np.full(len(b), UNBOUNDED)])
    below = np.concatenate([lower, b])
    u, _, flag, _ = daqp.solve(np.eye(n), -u_nom, np.ascontiguousarray(A), above, below, np.zeros(n + len(b), np.int32))
    return np.array(u) if flag == 1 else np.full(n, np.nan)


def piqp_optimum(A: np.ndarray, b: np.ndarray, lower: np.ndarray, upper: np.ndarray, u_nom: np.ndarray) -> np.ndarray:
    """Return the same optimum by PIQP, an interior-point method."""
    import piqp  # noqa: PLC0415

    solver = piqp.DenseSolver()
    solver.settings.eps_abs = solver.settings.eps_rel = 1e-12
    n = len(u_nom)
    none, zero = np.zeros((0, n)), np.zeros(0)
    solver.setup(np.eye(n), -u_nom, none, zero, A, b, np.full(len(b), np.inf), lower, upper)
    solver.solve()
    return np.array(solver.result.x)
