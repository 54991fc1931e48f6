"""Rows of the QP in control space, and the ranks by which they are relaxed."""

from __future__ import annotations

from collections.abc import Sequence
from enum import IntEnum
from typing import NamedTuple, Protocol

import msgspec
import numpy as np
from numpy.typing import NDArray

from dualbrain.robots.interface import RobotState

Array = NDArray[np.float64]


class Rank(IntEnum):
    """Order in which rows are relaxed if no control satisfies all of them: the highest number first.

    The box of joint velocity, acceleration and position is never relaxed, and neither is the row of a static obstacle
    as long as braking satisfies it.
    """

    BODY = 1
    """People and links of the robot."""
    OBSTACLE = 2
    """Objects."""
    WORKSPACE = 3
    """Limits of the workspace."""
    TASK = 4
    """Preferences of a task, and rows of the application."""


class ConstraintRow(msgspec.Struct, frozen=True, kw_only=True):
    """One row a'u ≥ b for one step: `a` (n,), `b`, and the barrier value `h` that the filter reports with it."""

    name: str
    a: tuple[float, ...]
    b: float
    h: float = 0.0
    rank: Rank = Rank.TASK


class BarrierRow(NamedTuple):
    """One row a'u ≥ b of the last step as the filter posed it, scaled to unit length: b and a'u are in rad/s.

    `name` is the pair or limit, `barrier` the name of the barrier. `h` [m] is the barrier value without the sampling
    margin, `norm` [m/rad] the length of the normal before scaling. `kind`, `i`, `j` are indices of the kernel.
    """

    name: str
    barrier: str
    h: float
    a: Array
    b: float
    norm: float
    kind: int
    i: int
    j: int


class PythonBarrier(Protocol):
    """A barrier in Python whose rows are computed in every step, outside the compiled kernel.

    The certificate for the next step does not cover its rows, so they must include their own margins.
    """

    def rows(self, state: RobotState, jacobian: Array) -> Sequence[ConstraintRow]:
        """Rows at `state`; `jacobian` (6, n) of the tool, linear then angular, in the world frame."""
        ...


def row_table(rows: Sequence[ConstraintRow], n: int) -> Array:
    """Input table (k, n + 3) of the kernel with a, b, h, rank per row."""
    return np.array([[*row.a, row.b, row.h, float(row.rank)] for row in rows], float).reshape(-1, n + 3)
