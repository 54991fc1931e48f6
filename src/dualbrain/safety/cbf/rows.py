"""Rows in control space and their rank: what is given up last when no control can meet all of them."""

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
    """The order in which rows are given up when none can meet all: the highest number first.

    The box of joint velocity, acceleration and position is never given up, nor is a row about something that stands
    still as long as braking meets it.
    """

    BODY = 1
    """People and the robot's own parts."""
    OBSTACLE = 2
    """Things."""
    WORKSPACE = 3
    """Where the robot should stay."""
    TASK = 4
    """What is only wished for, and rows handed in by the user."""


class ConstraintRow(msgspec.Struct, frozen=True, kw_only=True):
    """One row a'u ≥ b for one step: `a` (n,), `b`, and the barrier value `h` that is reported with it."""

    name: str
    a: tuple[float, ...]
    b: float
    h: float = 0.0
    rank: Rank = Rank.TASK


class BarrierRow(NamedTuple):
    """One row a'u ≥ b of the last step as the filter stated it, a unit row: b and a'u in rad/s.

    `name` says whose row it is and `barrier` of which barrier; `h` [m] is its barrier value without the sampling
    margin, `norm` [m/rad] the length of its normal before it was made a unit row. `kind`, `i`, `j` are the kernel's
    own indices.
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
    """A barrier whose rows are computed anew in every step, outside the compiled kernel.

    The next-step certificate does not cover its rows; their own margin must.
    """

    def rows(self, state: RobotState, jacobian: Array) -> Sequence[ConstraintRow]:
        """Rows at `state`; `jacobian` (6, n) is the tool's, linear then angular, in the world frame."""
        ...


def row_table(rows: Sequence[ConstraintRow], n: int) -> Array:
    """The table (k, n + 3) of a, b, h, rank that the kernel reads."""
    return np.array([[*row.a, row.b, row.h, float(row.rank)] for row in rows], float).reshape(-1, n + 3)
