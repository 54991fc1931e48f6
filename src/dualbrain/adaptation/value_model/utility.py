"""The utility of one executed contract: success first, then little intervention, then little time.

    U = r · (1 − ½ min(Δ/Δ₀, 1) − κ max(0, T − T₀)),   Δ₀ = 0.01, κ = 0.002 1/s, T₀ = 12 s

r ∈ {0, 1} is the success label, Δ the mean intervention (paper 5.2), T the duration [s]. Without the term of time, the
slowest contract would always be the best one.
"""

from __future__ import annotations

DELTA_SCALE, TIME_WEIGHT, FREE_TIME = 0.01, 0.002, 12.0
"""Δ₀, κ [1/s] and T₀ [s]."""


def utility(*, succeeded: bool, Delta: float | None, duration: float) -> float:
    """U of an outcome with intervention Δ (None: nothing was corrected) and `duration` [s]."""
    if not succeeded:
        return 0.0
    intervention = min((Delta or 0.0) / DELTA_SCALE, 1.0)
    return 1.0 - 0.5 * intervention - TIME_WEIGHT * max(0.0, duration - FREE_TIME)
