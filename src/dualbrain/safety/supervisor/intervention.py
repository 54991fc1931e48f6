"""Intervention δ after the supervisor: consistency of a filter result, and δ with the supervisor's part.

    δ = ‖u − u_nom‖_W = δ_rows + δ_box + δ_supervisor      (paper 4.4, with the u_nom of the skill)

δ_rows and δ_box are those of the filter, relative to the scaled nominal control; the remainder is δ_supervisor.
"""

from __future__ import annotations

from math import isfinite, sqrt

import msgspec
import numpy as np
from numpy.typing import NDArray

from dualbrain.safety.cbf.result import FilterResult

Array = NDArray[np.float64]

MAX_DELTA = 2.0
"""Largest value of δ."""
DELTA_TOLERANCE = 1e-3
"""Accepted difference between the reported and the recomputed δ: 0.1 % of full speed, far above float32 rounding."""


def compute_delta(result: FilterResult, u: Array, u_nom: Array) -> float:
    """δ of `u` relative to `u_nom`, each (n,) [rad/s], by the formula of the kernel."""
    gaps = [(a - b) / most for a, b, most in zip(u.tolist(), u_nom.tolist(), result.names.v_max, strict=True)]
    return min(sqrt(sum(gap * gap for gap in gaps) / len(gaps)), MAX_DELTA)


def is_consistent(result: FilterResult, u_nom: Array) -> bool:
    """Whether the δ of `result` is the δ of its control relative to `u_nom` (n,) [rad/s], the filter's input.

    This detects a filter that hangs and repeats an old result, as soon as the nominal control or the control should
    have changed. A nominal control that is not finite has no δ; the filter rejects it itself.
    """
    expected = compute_delta(result, result.u, u_nom)
    return not isfinite(expected) or abs(expected - result.delta) <= DELTA_TOLERANCE


def with_supervisor_control(result: FilterResult, u_nom: Array, u: Array) -> FilterResult:
    """`result` with the control `u` that is written, and δ relative to the skill's `u_nom`, each (n,) [rad/s]."""
    total = compute_delta(result, u, u_nom)
    share = min(1.0, total / result.delta) if result.delta > 0.0 else 0.0
    rows, box = share * result.delta_rows, share * result.delta_box
    return msgspec.structs.replace(
        result,
        u=u,
        u_nom=u_nom,
        delta=total,
        delta_rows=rows,
        delta_box=box,
        delta_supervisor=max(0.0, total - rows - box),
    )
