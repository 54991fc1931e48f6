"""What a barrier says of itself, and a case in which it must hold."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import msgspec
import numpy as np
from numpy.typing import NDArray

from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.safety.cbf.rows import Rank

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True)
class Scenario:
    """A robot that is pushed against a barrier, and h measured apart from the kernel.

    `start` is a configuration q in which h > 0, `push(q)` the nominal control u_nom (n,) that would break the barrier,
    `h(q, u)` the barrier value at configuration q under control u, in float64.
    """

    safety: SafetyFilter
    start: Array
    nominal: Callable[[Array], Array]
    h: Callable[[Array, Array], float]
    duration: float = 1.5


class BarrierSpec(msgspec.Struct, frozen=True, kw_only=True):
    """One thing that the filter keeps. What stands here appears in the docs, the tests and the live view.

    `rank` is None for what is part of the box of admissible controls and never given up. `margins` name what is kept
    beyond h = 0: sampling, tracking, measurement, age, rounding. `holds` is False for barriers that slow without
    stopping: they make no promise about h.
    """

    name: str
    description: str
    h: str
    row: str
    rank: Rank | None
    alpha: str
    margins: tuple[str, ...]
    source: str
    implementation: str
    scenario: Callable[[], Scenario]
    keeps_h_positive: bool = True
