"""Filtering of many independent states in one call, for Monte-Carlo studies and learning."""

from __future__ import annotations

import msgspec
import numpy as np
from numpy.typing import ArrayLike, NDArray

from dualbrain.core.geometry.validation import as_real_array, is_real
from dualbrain.errors import GeometryError
from dualbrain.safety.cbf.compiled._kernel import Kernel
from dualbrain.safety.cbf.result import FilterStatus
from dualbrain.safety.stop_cause import StopCause, stop_cause

Array = NDArray[np.float64]


class BatchResult(msgspec.Struct, frozen=True, eq=False, kw_only=True):
    """Results of the filter for m states.

    `u` (m, n) [rad/s]; `status` (m,), values of `FilterStatus`; `delta` (m,); `h_min` (m,) [m], NaN where the filter
    rejected the input; `flags` (m,), bits of `Reason`.
    """

    u: Array
    status: NDArray[np.int8]
    delta: Array
    h_min: Array
    flags: NDArray[np.int32]

    @property
    def causes(self) -> tuple[StopCause | None, ...]:
        """The cause of each STOPPED or FAULT, and None for the other states."""
        return tuple(
            stop_cause(int(flags)) if status >= FilterStatus.STOPPED else None
            for status, flags in zip(self.status, self.flags, strict=True)
        )


def run_batch(
    kernel: Kernel,
    n: int,
    Q: ArrayLike,
    V: ArrayLike,
    U: ArrayLike,
    u_prev: ArrayLike,
    opening: ArrayLike | None,
    scene_age: float,
) -> BatchResult:
    """Filter each row of Q, V and U (m, n) with `kernel`, from its own `u_prev`.

    `opening` [m] is one number or an array (m,), or None if it is unknown; `scene_age` is in s.

    Raises:
        ConfigurationError: Q, V, U and `u_prev` do not all have the shape (m, n) or are not numbers.
    """
    given = {"Q": Q, "V": V, "U": U, "u_prev": u_prev}
    q, v, u_nom, previous = arrays = [as_real_array(name, values) for name, values in given.items()]
    m, shapes = len(q) if q.ndim else 0, [values.shape for values in arrays]
    if any(shape != (m, n) for shape in shapes):
        raise GeometryError("batch", got=shapes, allowed=f"Q, V, U, u_prev of shape (m, {n})")
    result = BatchResult(
        u=np.empty((m, n)),
        status=np.empty(m, np.int8),
        delta=np.empty(m),
        h_min=np.empty(m),
        flags=np.empty(m, np.int32),
    )
    outputs = (result.u, result.status, result.delta, result.h_min, result.flags)
    kernel.batch(q, v, u_nom, previous, _openings(opening, m), scene_age, *outputs)
    return result


def _openings(opening: ArrayLike | None, m: int) -> Array:
    """The opening of every state (m,); an empty array if it is unknown."""
    if opening is None:
        return np.empty(0)
    if is_real(opening):
        return np.full(m, opening, float)
    return as_real_array("opening of a batch", opening, (m,))
