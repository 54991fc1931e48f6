"""The filter's answer after the supervisor: the control finally written, and δ with its third cause.

    δ = ‖u − u_nom‖_W = δ_rows + δ_box + δ_supervisor      (paper 4.4, with u_nom as the skill meant it)

δ_rows and δ_box are the filter's, against the nominal that it was given; what more the order took is the supervisor's.
"""

from __future__ import annotations

from math import sqrt

import msgspec
import numpy as np
from numpy.typing import NDArray

from dualbrain.safety.result import Filtered

Array = NDArray[np.float64]

LARGEST = 2.0
"""δ lies in [0, 2]."""


def supervised(result: Filtered, u_nom: Array, u: Array) -> Filtered:
    """`result` with the control `u` that is written, and δ against the skill's own `u_nom`, each (n,) [rad/s]."""
    gap = (u - u_nom) / np.array(result.names.v_max)
    total = min(sqrt(float(np.mean(gap * gap))), LARGEST)
    share = min(1.0, total / result.delta) if result.delta > 0.0 else 0.0
    rows, box = share * result.delta_rows, share * result.delta_box
    return msgspec.structs.replace(
        result, u=u, u_nom=u_nom, delta=total, delta_rows=rows, delta_box=box,
        delta_supervisor=max(0.0, total - rows - box),
    )  # fmt: skip
