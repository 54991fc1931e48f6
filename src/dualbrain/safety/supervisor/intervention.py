"""The filter's answer after the supervisor: whether it is one, the control finally written, and δ with its third cause.

    δ = ‖u − u_nom‖_W = δ_rows + δ_box + δ_supervisor      (paper 4.4, with u_nom as the skill meant it)

δ_rows and δ_box are the filter's, against the nominal that it was given; what more the order took is the supervisor's.
"""

from __future__ import annotations

from math import isfinite, sqrt

import msgspec
import numpy as np
from numpy.typing import NDArray

from dualbrain.safety.cbf.result import FilterResult

Array = NDArray[np.float64]

MAX_DELTA = 2.0
"""δ lies in [0, 2]."""
DELTA_TOLERANCE = 1e-3
"""How far δ as told and as measured may lie apart: far above the kernel's rounding, 0.1 % of full speed."""


def compute_delta(result: FilterResult, u: Array, u_nom: Array) -> float:
    """δ of `u` against `u_nom`, each (n,) [rad/s], as in the kernel."""
    gaps = [(a - b) / most for a, b, most in zip(u.tolist(), u_nom.tolist(), result.names.v_max, strict=True)]
    return min(sqrt(sum(gap * gap for gap in gaps) / len(gaps)), MAX_DELTA)


def is_consistent(result: FilterResult, u_nom: Array) -> bool:
    """Whether the control in `result` is the one that its δ speaks of, for the nominal (n,) [rad/s] that was asked for.

    An answer to an earlier question (a filter that hangs and repeats itself) is found out as soon as it matters: when
    nominal or control should have changed. A nominal that is not finite has no δ; the filter refuses it by itself.
    """
    told = compute_delta(result, result.u, u_nom)
    return not isfinite(told) or abs(told - result.delta) <= DELTA_TOLERANCE


def with_supervisor_control(result: FilterResult, u_nom: Array, u: Array) -> FilterResult:
    """`result` with the control `u` that is written, and δ against the skill's own `u_nom`, each (n,) [rad/s]."""
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
