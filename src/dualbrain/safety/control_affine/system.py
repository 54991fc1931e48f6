"""Input of the control-affine filter: the system ẋ = f(x) + g(x) u and the barriers h(x) ≥ 0."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import msgspec
import numpy as np

from dualbrain.errors import ConfigurationError, MissingDependencyError
from dualbrain.safety.cbf.rows import Rank

Expression = Any
"""A CasADi expression (SX or MX)."""
ClassK = float | Callable[[Expression], Expression]
"""A class-K function: a gain [1/s], or an increasing function of one expression that is 0 at 0."""


def import_casadi() -> Any:
    """The package casadi; raises `MissingDependencyError` with the command that installs it."""
    try:
        import casadi  # noqa: PLC0415  # heavy, and an optional extra
    except ImportError as error:
        raise MissingDependencyError(
            "The package casadi", fix="Install it with `pip install 'dualbrain[symbolic]'`."
        ) from error
    return casadi


class Barrier(msgspec.Struct, frozen=True, kw_only=True):
    """One barrier h(x) ≥ 0: a scalar expression in the state of the system.

    `alphas` has one class-K function for each order, or one for all: ψ_i = ψ̇_{i−1} + α_i(ψ_{i−1}). `margin` is the
    margin of the row beyond zero, in units of h/s^r. `rank` is the order of relaxation if rows conflict.
    """

    name: str
    h: Expression
    alphas: ClassK | tuple[ClassK, ...] | list[ClassK] = 1.0
    margin: float = 0.0
    rank: Rank = Rank.TASK

    def alpha(self, order: int, degree: int) -> ClassK:
        """The class-K function of one order, from 1 to `degree`.

        Raises:
            ConfigurationError: the number of `alphas` is neither 1 nor `degree`, or a gain is not finite and above 0.
        """
        alphas: Any = self.alphas
        given: list[Any] = list(alphas) if _is_sequence(alphas) else [alphas] * degree
        if len(given) != degree:
            raise ConfigurationError(
                f"alphas of barrier {self.name!r}",
                got=len(given),
                allowed=f"{degree}, one for each order of its relative degree, or a single one for all",
            )
        alpha = given[order - 1]
        if isinstance(alpha, (int, float)) and not 0.0 < alpha < np.inf:
            raise ConfigurationError(f"alphas of barrier {self.name!r}", got=alpha, allowed="a finite gain above 0")
        return alpha


class ControlAffine:
    """The system ẋ = f(x) + g(x) u with n states and m controls."""

    def __init__(self, x: Expression, f: Expression | Sequence[Expression], g: Expression | Sequence[Any]) -> None:
        """`x` is a column of symbols; `f` (n,) and `g` (n, m) are expressions in it, or lists of expressions.

        Raises:
            ConfigurationError: `x` is not a column of symbols, a shape is wrong, or f or g has symbols that are not
                in `x`.
        """
        ca = import_casadi()
        if not (isinstance(x, (ca.SX, ca.MX)) and x.is_column() and x.is_valid_input()):
            raise ConfigurationError("state x of the system", got=str(x), allowed="a column of casadi symbols")
        self.x, self.n = x, int(x.numel())
        self.f = self.to_expression(f, "f")
        self.g = self._columns(g)
        self.m = int(self.g.size2())
        if self.f.shape != (self.n, 1):
            raise ConfigurationError("shape of f", got=self.f.shape, allowed=f"({self.n}, 1), one entry for each state")
        if self.g.size1() != self.n or self.m < 1:
            raise ConfigurationError("shape of g", got=self.g.shape, allowed=f"({self.n}, m), one row for each state")
        self.compile_function("f and g", [ca.horzcat(self.f, self.g)])

    def to_expression(self, value: Any, what: str) -> Expression:
        """A CasADi column (k, 1) of the type of the state (SX or MX).

        `value` is an expression (k, 1), a number, or a list of k scalar expressions and numbers; units are those of
        the caller. `what` names the value in the error.

        Raises:
            ConfigurationError: `value` contains something else, or an expression of the other type.
        """
        ca = import_casadi()
        try:
            return ca.vertcat(type(self.x)(0, 0), *(value if _is_sequence(value) else [value]))
        except (NotImplementedError, RuntimeError, TypeError) as error:
            raise ConfigurationError(
                what, got=str(value), allowed=f"numbers or {type(self.x).__name__} expressions"
            ) from error

    def _columns(self, g: Any) -> Expression:
        """The matrix g; a flat list is its single column, a list of lists contains its rows."""
        ca = import_casadi()
        if _is_sequence(g) and any(_is_sequence(row) for row in g):
            return ca.vertcat(*(ca.horzcat(type(self.x)(0, 0), *row) for row in g))
        return self.to_expression(g, "g")

    def compile_function(self, what: str, outputs: list[Expression]) -> Any:
        """A compiled function of the state; raises `ConfigurationError` if `outputs` have other symbols."""
        ca = import_casadi()
        function = ca.Function("rows", [self.x], [ca.densify(out) for out in outputs], {"allow_free": True})
        if function.has_free():
            raise ConfigurationError(
                what, got=f"free symbols {function.get_free()}", allowed=f"expressions in the state {self.x}"
            )
        return function


def _is_sequence(value: Any) -> bool:
    return isinstance(value, (list, tuple))
