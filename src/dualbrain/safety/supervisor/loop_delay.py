"""How far the control loop is behind the robot: commands that stay in force longer than the filter counts on.

A control is safe for the period that it is meant for. In a gap g between two ticks it stays in force for g: the arm
goes on, by at most v (g − dt), and a loop that is always late brakes only by one period's worth a gap. What was late is
summed up, and forgotten with the time constant T:

    b ← b exp(−g/T) + (g − dt)      for g > 2.5 dt and a command that was not zero, else b exp(−g/T)

While b has not reached its bound, a joint comes nearer to its limit by at most v b ≤ α h b (the barrier lets it go at
α h at the distance h): with b well below 1/α it stops short of the limit. Beyond the bound the drive brakes by itself.
"""

from __future__ import annotations

from math import exp, isfinite, nan

LATE_TICK_PERIODS = 2.5
"""Periods between two ticks beyond which one was late."""
DECAY_TIME = 0.2
"""Time constant T in which lateness is forgotten [s]."""
MAX_DELAY = 0.1
"""No more than this is held against a loop [s], so that one long stall is forgotten soon."""


class LoopDelay:
    """`update(now, stamp)` once a tick. A gap counts only as far as both clocks tell it, as each may be broken alone.

    While the robot itself is silent its stamps stand still, and the loop is not to blame.
    """

    def __init__(self, period: float) -> None:
        """Nothing was late; `period` dt [s]."""
        self._period = period
        self._now, self._stamp = nan, nan
        self.delay = 0.0

    def update(self, now: float, stamp: float, *, moving: bool) -> float:
        """Sum b [s] after a tick at `now` [s] of the layer's clock and `stamp` [s] of the robot's.

        `moving`: the command that was in force until now was not zero.
        """
        gaps = (now - self._now, stamp - self._stamp)
        self._now, self._stamp = now, stamp
        gap = max(min(gaps), self._period) if all(map(isfinite, gaps)) else self._period
        late = gap - self._period if moving and gap > LATE_TICK_PERIODS * self._period else 0.0
        self.delay = min(MAX_DELAY, self.delay * exp(-gap / DECAY_TIME) + late)
        return self.delay
