"""Many states at once, each on its own: what Monte-Carlo and learning ask the filter."""

from __future__ import annotations

import msgspec
import numpy as np
from numpy.typing import ArrayLike, NDArray

from dualbrain.errors import ConfigurationError
from dualbrain.safety.cbf.compiled._kernel import Kernel

Array = NDArray[np.float64]


class BatchResult(msgspec.Struct, frozen=True, eq=False):
    """m answers of the filter.

    `u` (m, n) [rad/s]; `status` (m,), values of `Status`; `delta` (m,); `h_min` (m,) [m], NaN where the input
    was refused.
    """

    u: Array
    status: NDArray[np.int8]
    delta: Array
    h_min: Array


def run_batch(
    kernel: Kernel,
    n: int,
    Q: ArrayLike,
    V: ArrayLike,
    U: ArrayLike,
    u_prev: ArrayLike,
    opening: ArrayLike,
    scene_age: float,
) -> BatchResult:
    """Every row of (m, n) through `kernel` from its own `u_prev`; `opening` [m] is one number or one per row.

    Raises:
        InvalidSetup: the arrays do not have one shape (m, n).
    """
    q, v, u_nom, last = (np.ascontiguousarray(values, float) for values in (Q, V, U, u_prev))
    m, shapes = len(q), [values.shape for values in (q, v, u_nom, last)]
    if any(shape != (m, n) for shape in shapes):
        raise ConfigurationError("batch", got=shapes, allowed=f"Q, V, U, u_prev of shape (m, {n})")
    answer = BatchResult(np.empty((m, n)), np.empty(m, np.int8), np.empty(m), np.empty(m))
    openings = np.ascontiguousarray(np.broadcast_to(np.asarray(opening, float), (m,)))
    kernel.batch(q, v, u_nom, last, openings, scene_age, answer.u, answer.status, answer.delta, answer.h_min)
    return answer
