"""Description of a barrier, and a scenario that tests it."""

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
    """A robot that is pushed against a barrier, with h computed independently of the kernel.

    `start` is a configuration q with h > 0. `nominal(q)` is a nominal control u_nom (n,) that would violate the
    barrier. `h(q, u)` is the barrier value at configuration q under control u, in float64. `duration` is in s.
    """

    safety: SafetyFilter
    start: Array
    nominal: Callable[[Array], Array]
    h: Callable[[Array, Array], float]
    duration: float = 1.5


class BarrierSpec(msgspec.Struct, frozen=True, kw_only=True):
    """Description of one barrier, as the documentation, the tests and the live view show it.

    `rank` is None for limits that are part of the box of admissible controls, which is never relaxed. `margins` lists
    the margins beyond h = 0: sampling, tracking, measurement, age, rounding. `keeps_h_positive` is False for a barrier
    that slows the robot without stopping it and does not guarantee h ≥ 0.
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
