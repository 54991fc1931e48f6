"""Relative degree of a barrier: the number of derivatives of h until the controls appear."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from dualbrain.errors import ConfigurationError
from dualbrain.safety.control_affine.system import Barrier, ControlAffine, Expression, import_casadi

Array = NDArray[np.float64]
N_TEST_STATES = 64
"""Number of states at which a derivative is evaluated."""
ZERO_TOLERANCE = 1e-9
"""Sums below this fraction of their terms count as zero, because the terms cancel up to rounding."""


def relative_degree(system: ControlAffine, barrier: Barrier, domain: tuple[Array, Array]) -> int:
    """The smallest r with L_g L_f^{r−1} h ≠ 0 at every test state in `domain` ((n,), (n,)).

    An entry is zero if it is structurally zero or cancels at all states.

    Raises:
        ConfigurationError: h does not depend on the state, no control appears in any derivative of h, or r is not the
            same at all states.
    """
    ca = import_casadi()
    h = scalar_barrier(system, barrier)
    states = spread_states(*domain)
    for r in range(1, system.n + 1):
        gradient = ca.jacobian(h, system.x)
        if r == 1:
            _check_dependence(system, barrier, gradient, states)
        affected = _controls_appear(system, barrier, gradient, states)
        if affected.all() and len(affected):
            return r
        if affected.any():
            raise ConfigurationError(
                f"relative degree of barrier {barrier.name!r}",
                got=f"{r} at {int(affected.sum())} of {len(affected)} states, more at the others",
                allowed="the same at all states",
                fix="Write the barrier without switches, or pass the `domain` in which it is used.",
            )
        h = ca.mtimes(gradient, system.f)
    raise ConfigurationError(
        f"relative degree of barrier {barrier.name!r}",
        got=f"none up to {system.n}, the number of states",
        allowed="a barrier that the controls can change",
    )


def scalar_barrier(system: ControlAffine, barrier: Barrier) -> Expression:
    """The function h of the barrier as one scalar expression of the state; raises `ConfigurationError`."""
    h = system.to_expression(barrier.h, f"h of barrier {barrier.name!r}")
    if h.numel() != 1:
        raise ConfigurationError(f"h of barrier {barrier.name!r}", got=h.shape, allowed="one number")
    return h


def spread_states(lower: Array, upper: Array) -> Array:
    """`N_TEST_STATES` states (k, n) that fill the box [lower, upper] evenly (Kronecker sequence of a golden mean).

    Their coordinates are irrational, so that they avoid surfaces on which a derivative vanishes by chance.
    """
    n, mean = len(lower), 2.0
    for _ in range(40):
        mean = (1.0 + mean) ** (1.0 / (n + 1))
    steps = mean ** -np.arange(1.0, n + 1.0)
    return lower + (upper - lower) * ((0.5 + np.arange(1, N_TEST_STATES + 1)[:, None] * steps) % 1.0)


def _check_dependence(system: ControlAffine, barrier: Barrier, gradient: Expression, states: Array) -> None:
    if gradient.nnz() == 0 or not np.any(_values(system, barrier, gradient, states)):
        raise ConfigurationError(
            f"h of barrier {barrier.name!r}", got=str(barrier.h), allowed=f"an expression in the state {system.x}"
        )


def _controls_appear(system: ControlAffine, barrier: Barrier, gradient: Expression, states: Array) -> NDArray[np.bool_]:
    """Mask (k,) of states at which a control affects the derivative; all False if it is structurally zero."""
    ca = import_casadi()
    entries = ca.mtimes(gradient, system.g)
    if entries.nnz() == 0:
        return np.zeros(len(states), bool)
    terms = ca.mtimes(ca.fabs(gradient), ca.fabs(system.g))
    values = _values(system, barrier, ca.vertcat(entries, terms), states).reshape(len(states), system.m, 2)
    known = np.isfinite(values).all(axis=(1, 2))
    if not known.any():
        raise ConfigurationError(
            f"derivatives of barrier {barrier.name!r}",
            got="no finite value",
            allowed="a domain where h is smooth",
            fix="Pass a `domain` in which h, f and g are defined.",
        )
    return np.any(np.abs(values[known, :, 0]) > ZERO_TOLERANCE * values[known, :, 1], axis=1)


def _values(system: ControlAffine, barrier: Barrier, expression: Expression, states: Array) -> Array:
    """Entries of the expression in column-major order at every state: (k, entries)."""
    function: Any = system.compile_function(f"barrier {barrier.name!r}", [expression])
    return np.array([np.asarray(function(state), float).ravel(order="F") for state in states])
