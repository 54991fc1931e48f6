"""Filtering of many independent states in one call, for Monte-Carlo studies and learning."""

from __future__ import annotations

import msgspec
import numpy as np
from numpy.typing import ArrayLike, NDArray

from dualbrain.errors import ConfigurationError
from dualbrain.safety.cbf.compiled._kernel import Kernel

Array = NDArray[np.float64]


class BatchResult(msgspec.Struct, frozen=True, eq=False):
    """Results of the filter for m states.

    `u` (m, n) [rad/s]; `status` (m,), values of `FilterStatus`; `delta` (m,); `h_min` (m,) [m], NaN where the filter
    rejected the input.
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
    """Filter each row of Q, V and U (m, n) with `kernel`, from its own `u_prev`.

    `opening` [m] is one number or an array (m,); `scene_age` is in s.

    Raises:
        ConfigurationError: Q, V, U and `u_prev` do not all have the shape (m, n).
    """
    q, v, u_nom, previous = (np.ascontiguousarray(values, float) for values in (Q, V, U, u_prev))
    m, shapes = len(q), [values.shape for values in (q, v, u_nom, previous)]
    if any(shape != (m, n) for shape in shapes):
        raise ConfigurationError("batch", got=shapes, allowed=f"Q, V, U, u_prev of shape (m, {n})")
    result = BatchResult(np.empty((m, n)), np.empty(m, np.int8), np.empty(m), np.empty(m))
    openings = np.ascontiguousarray(np.broadcast_to(np.asarray(opening, float), (m,)))
    kernel.batch(q, v, u_nom, previous, openings, scene_age, result.u, result.status, result.delta, result.h_min)
    return result
