"""Accumulated delay of the control loop: the time for which commands stay in force longer than one period.

A control is certified for one period. In a gap g between two ticks it stays in force for g, so that the arm moves on by
at most v (g − dt), and a loop that is always late brakes by only one period's worth per gap. The delay b sums up the
excess and decays with the time constant T:

    b ← b exp(−g/T) + (g − dt)      for g > 2.5 dt and a non-zero command, else b exp(−g/T)

While b is below its bound, a joint approaches its limit by at most v b ≤ α h b, because the barrier allows the speed
α h at the distance h. With b well below 1/α the joint stops before the limit. Beyond the bound the drive is switched
off and brakes by itself.
"""

from __future__ import annotations

from math import exp, isfinite, nan

LATE_TICK_PERIODS = 2.5
"""A gap between two ticks is late if it exceeds this number of periods."""
DECAY_TIME = 0.2
"""Time constant T of the decay [s]."""
MAX_DELAY = 0.1
"""Upper limit of the delay [s], so that the effect of one long stall soon decays."""


class LoopDelay:
    """Delay b of a control loop. A gap counts only as far as both clocks show it, because either may be faulty.

    While the robot sends no states its stamps do not advance, and no delay is added.
    """

    def __init__(self, period: float) -> None:
        """Start without delay; `period` is dt [s]."""
        self._period = period
        self._now, self._stamp = nan, nan
        self.delay = 0.0

    def update(self, now: float, stamp: float, *, moving: bool) -> float:
        """Delay b [s] after a tick at `now` [s] by the clock of the loop and `stamp` [s] by that of the robot.

        `moving`: the command in force until now was not zero.
        """
        gaps = (now - self._now, stamp - self._stamp)
        self._now, self._stamp = now, stamp
        gap = max(min(gaps), self._period) if all(map(isfinite, gaps)) else self._period
        late = gap - self._period if moving and gap > LATE_TICK_PERIODS * self._period else 0.0
        self.delay = min(MAX_DELAY, self.delay * exp(-gap / DECAY_TIME) + late)
        return self.delay
