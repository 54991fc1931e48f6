"""Safety filter for control-affine systems: one row per barrier, solved by the QP of the C kernel."""

from __future__ import annotations

from collections.abc import Sequence

import msgspec
import numpy as np
from numpy.typing import ArrayLike, NDArray

from dualbrain.errors import ConfigurationError
from dualbrain.safety.cbf.qp import ControlQp, QpResult
from dualbrain.safety.cbf.relaxation import RelaxationProblem, floor_at_control, floor_in_box
from dualbrain.safety.cbf.result import FilterStatus, Reason
from dualbrain.safety.cbf.rows import Rank
from dualbrain.safety.control_affine.result import FilteredControl
from dualbrain.safety.control_affine.rows import CompiledRows
from dualbrain.safety.control_affine.system import Barrier, ControlAffine
from dualbrain.safety.stop_cause import describe_not_finite

Array = NDArray[np.float64]
UNLIMITED_CONTROL = 1e9
"""Replacement for an infinite bound, in units of the control."""


class ControlAffineFilter:
    """Closest safe control of ẋ = f(x) + g(x) u: min ½‖u − u_nom‖²_R s.t. one row for every barrier, u in the box.

    Guarantee (Xiao and Belta, CDC 2019): if every ψ_i, i < r, is at least 0 at the start, the system moves exactly as
    modelled, and the result is `certified` at every state, then every h stays at least 0. The guarantee does not cover
    states where rows conflict with the box or with each other (RELAXED), nor singular states, where L_g L_f^{r−1} h = 0
    and the controls have no effect on the row. A control that is held for a period dt loses the curvature of ψ_{r−1}:
    with α_r dt ≤ 1 a `margin` of dt/2 · max |d²ψ_{r−1}/dt²| covers it.

    Conflicting rows are relaxed by rank, each rank as little as possible. With a `fallback` no row is violated more
    than by that control.
    """

    def __init__(
        self,
        system: ControlAffine,
        barriers: Sequence[Barrier],
        lower: ArrayLike = -np.inf,
        upper: ArrayLike = np.inf,
        *,
        weight: Array | None = None,
        fallback: ArrayLike | None = None,
        domain: tuple[ArrayLike, ArrayLike] = (-1.0, 1.0),
    ) -> None:
        """`lower` and `upper` (m,) are the box, `weight` is R (m, m), by default diag(1/half range²).

        `fallback` (m,) is the control of last resort (braking), by default 0. `domain` are bounds (n,) between which
        relative degrees are tested.

        Raises:
            ConfigurationError: there are no barriers or a name occurs twice, the box is empty, a shape is wrong, or a
                barrier has no relative degree.
        """
        self.system, self.barriers = system, tuple(barriers)
        self._names = tuple(barrier.name for barrier in self.barriers)
        if not self.barriers or len(set(self._names)) < len(self._names):
            raise ConfigurationError("barriers", got=self._names, allowed="one or more, with distinct names")
        low, high = _as_vector(lower, system.m, "lower"), _as_vector(upper, system.m, "upper")
        if not np.all(low <= high):
            raise ConfigurationError("box of the controls", got=(low.tolist(), high.tolist()), allowed="lower ≤ upper")
        half = 0.5 * (high - low)
        self._unit = np.where(np.isfinite(half) & (half > 0.0), half, 1.0)
        self._qp = ControlQp(self._unit, weight)
        limit = UNLIMITED_CONTROL * self._unit
        self._lower, self._upper = np.maximum(low, -limit), np.minimum(high, limit)
        self._has_fallback = fallback is not None
        last = _as_vector(0.0 if fallback is None else fallback, system.m, "fallback")
        self._fallback = np.clip(last, self._lower, self._upper)
        bounds = (_as_vector(domain[0], system.n, "domain"), _as_vector(domain[1], system.n, "domain"))
        self._rows = CompiledRows(system, self.barriers, bounds)
        self._ranks = np.array([int(barrier.rank) for barrier in self.barriers], np.int64)
        self._chain_ends = np.cumsum(self._rows.degrees)[:-1]

    @property
    def relative_degrees(self) -> tuple[int, ...]:
        """The relative degree of every barrier."""
        return self._rows.degrees

    def rows(self, x: Array) -> tuple[Array, Array]:
        """A (k, m) and b (k,) of the rows A u ≥ b at the state x (n,)."""
        A, b, _ = self._rows.evaluate(x)
        return A, b

    def __call__(self, x: ArrayLike, u_nom: ArrayLike) -> FilteredControl:
        """The safe control for the state x (n,) that is closest to u_nom (m,)."""
        state, desired = _as_vector(x, self.system.n, "state x"), _as_vector(u_nom, self.system.m, "u_nom")
        A, b, psi = self._rows.evaluate(state)
        if not (np.isfinite(state).all() and np.isfinite(desired).all() and _all_finite(A, b, psi)):
            detail = describe_not_finite(x=state, u_nom=desired) or self._describe_barrier(A, b)
            stopped = self._result(self._fallback, desired, FilterStatus.STOPPED, Reason.BAD_INPUT)
            return msgspec.structs.replace(stopped, detail=detail)
        chains = tuple(tuple(map(float, chain)) for chain in np.split(psi, self._chain_ends))
        limit = UNLIMITED_CONTROL * self._unit
        found = self._qp.solve(A, b, self._lower, self._upper, np.clip(desired, -limit, limit))
        if found.rows_met:
            status = FilterStatus.SAFE if np.array_equal(found.u, desired) else FilterStatus.MODIFIED
            return self._result(found.u, desired, status, Reason(0), chains, found)
        relaxed, relaxed_ranks = self._relaxation_problem(A, b).solve(self._ranks)
        if not relaxed.rows_met:
            stopped = self._result(self._fallback, desired, FilterStatus.STOPPED, Reason.QP_ITERATIONS, chains, found)
            return msgspec.structs.replace(stopped, detail=f"{found.iterations} iterations for {len(b)} rows")
        reason = Reason.QP_ITERATIONS if found.limit_reached else Reason.INFEASIBLE
        return self._result(relaxed.u, desired, FilterStatus.RELAXED, reason, chains, found, relaxed_ranks)

    def _describe_barrier(self, A: Array, b: Array) -> str:
        """The barrier whose row is not finite at a finite state."""
        bad = np.flatnonzero(~(np.isfinite(A).all(axis=1) & np.isfinite(b)))
        return (
            f"the row of barrier {self._names[bad[0]]!r} (0 to {len(b) - 1}: {bad[0]}) is not finite"
            if len(bad)
            else ""
        )

    def _relaxation_problem(self, A: Array, b: Array) -> RelaxationProblem:
        """The relaxation of rows A u ≥ b, with violations in units of the effect of half the box."""
        low, high, size = self._lower, self._upper, np.maximum(np.abs(A) @ self._unit, 1e-9)
        floor = floor_at_control(A, b, self._fallback) if self._has_fallback else floor_in_box(A, b, low, high)
        return RelaxationProblem(
            qp=self._qp, A=A, b=b, violation_unit=size, lower=low, upper=high, reference=self._fallback, floor=floor
        )

    def _result(
        self,
        u: Array,
        u_nom: Array,
        status: FilterStatus,
        reason: Reason,
        psi: tuple[tuple[float, ...], ...] = (),
        solution: QpResult | None = None,
        relaxed: tuple[int, ...] = (),
    ) -> FilteredControl:
        change = (u - np.clip(np.nan_to_num(u_nom), -1e12, 1e12)) / self._unit
        return FilteredControl(
            u=u,
            u_nom=u_nom,
            status=status,
            names=self._names,
            reason=reason,
            delta=float(np.sqrt(np.mean(change**2))),
            psi=psi,
            active_rows=self._active_rows(solution.active) if solution else (),
            relaxed_ranks=tuple(Rank(rank) for rank in relaxed),
            iterations=solution.iterations if solution else 0,
        )

    def _active_rows(self, active: tuple[tuple[int, float], ...]) -> tuple[tuple[str, float], ...]:
        m = self.system.m
        names = [f"u[{k}] {side}" for side in ("lower", "upper") for k in range(m)]
        return tuple(((*names, *self._names)[index], weight) for index, weight in active)


def _as_vector(value: ArrayLike, n: int, what: str) -> Array:
    array = np.asarray(value, float)
    if array.shape not in ((), (n,)):
        raise ConfigurationError(f"size of {what}", got=array.shape, allowed=f"{n} numbers, or one for all")
    return np.array(np.broadcast_to(array, (n,)))


def _all_finite(*arrays: Array) -> bool:
    return all(bool(np.isfinite(array).all()) for array in arrays)
