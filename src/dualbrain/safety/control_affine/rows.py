"""Derivation of rows from barriers: ψ of every order, Lie derivatives, and one compiled function for all rows."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from dualbrain.safety.control_affine.relative_degree import relative_degree, scalar_barrier
from dualbrain.safety.control_affine.system import Barrier, ControlAffine, Expression, import_casadi

Array = NDArray[np.float64]


class CompiledRows:
    """Rows A u ≥ b of k barriers at a state, evaluated by CasADi's virtual machine without copies.

    ψ_0 = h, ψ_i = L_f ψ_{i−1} + α_i(ψ_{i−1}) for i < r, and the row
    L_g ψ_{r−1} u ≥ −L_f ψ_{r−1} − α_r(ψ_{r−1}) + margin (Xiao and Belta, CDC 2019).
    """

    def __init__(self, system: ControlAffine, barriers: Sequence[Barrier], domain: tuple[Array, Array]) -> None:
        """Determine the relative degrees, derive the rows and compile them; raises `ConfigurationError`."""
        ca = import_casadi()
        self.degrees = tuple(relative_degree(system, barrier, domain) for barrier in barriers)
        derived = [derive_row(system, barrier, r) for barrier, r in zip(barriers, self.degrees, strict=True)]
        psi = ca.vertcat(*(p for chain, _, _ in derived for p in chain))
        A, b = ca.vertcat(*(a for _, a, _ in derived)), ca.vertcat(*(b for _, _, b in derived))
        self._function = system.compile_function("barriers", [A, b, psi])
        self._x = np.zeros(system.n)
        self._A, self._b = np.zeros((system.m, len(barriers))), np.zeros(len(barriers))
        self._psi = np.zeros(sum(self.degrees))
        self._buffer, self._evaluate = self._function.buffer()
        self._buffer.set_arg(0, memoryview(self._x.data))
        for index, array in enumerate((self._A, self._b, self._psi)):
            self._buffer.set_res(index, memoryview(array.data))

    def evaluate(self, x: Array) -> tuple[Array, Array, Array]:
        """A (k, m), b (k,) and ψ_0 to ψ_{r−1} of each barrier in sequence, at the state x (n,)."""
        self._x[:] = x
        self._evaluate()
        return np.ascontiguousarray(self._A.T), self._b.copy(), self._psi.copy()


def derive_row(system: ControlAffine, barrier: Barrier, degree: int) -> tuple[list[Expression], Expression, Expression]:
    """The chain ψ_0..ψ_{r−1}, the coefficients (1, m) and the bound of the row of a barrier of relative degree r."""
    ca = import_casadi()
    chain = [scalar_barrier(system, barrier)]
    for order in range(1, degree + 1):
        psi, alpha = chain[-1], barrier.alpha(order, degree)
        gradient = ca.jacobian(psi, system.x)
        drift = ca.mtimes(gradient, system.f) + (alpha(psi) if callable(alpha) else alpha * psi)
        if order < degree:
            chain.append(drift)
        else:
            return chain, ca.mtimes(gradient, system.g), barrier.margin - drift
    raise AssertionError("a relative degree is at least 1")
