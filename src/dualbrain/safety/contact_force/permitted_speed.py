"""Speed of permitted contacts under force: full at low force, zero at the permitted force.

    s(F) = clip((F_max − F)/(F_max − F_0), 0, 1),      F_0 = `full_speed_share` · F_max

s falls by at most `deceleration`/speed per second, so that the filter can brake as fast as the contact row closes, and
rises by at most `recovery`/speed; above F_max it is 0 at once, because the arm yields. It changes in steps of
1/`STEPS`, so that noise does not change the table of permits in every tick.
"""

from __future__ import annotations

from math import floor

from dualbrain.safety.contact_force.limits import ContactForceLimits

STEPS = 16
"""Number of steps between zero and full speed."""


def speed_scale(force: float, limits: ContactForceLimits) -> float:
    """The scale s of a permitted speed at `force` [N]."""
    most = limits.permitted.value
    least = limits.full_speed_share.value * most
    return min(1.0, max(0.0, (most - force) / (most - least)))


class PermittedSpeed:
    """The scale of all permitted contact speeds over time; `scale` is the one in force."""

    def __init__(self, limits: ContactForceLimits) -> None:
        """Start at full speed."""
        self._limits, self._exact = limits, 1.0
        self.scale = 1.0

    def reset(self) -> None:
        """Full speed, as at the beginning of a phase."""
        self._exact = self.scale = 1.0

    def update(self, force: float, fastest: float, elapsed: float) -> bool:
        """Follow `force` [N] for `elapsed` [s]; whether `scale` changed.

        `fastest` is the largest permitted speed [m/s].
        """
        wanted = speed_scale(force, self._limits)
        if fastest <= 0.0 or wanted == 0.0:
            self._exact = wanted
        elif wanted < self._exact:
            self._exact = max(wanted, self._exact - self._limits.deceleration.value * elapsed / fastest)
        else:
            self._exact = min(wanted, self._exact + self._limits.recovery.value * elapsed / fastest)
        scale = floor(self._exact * STEPS + 1e-9) / STEPS
        changed, self.scale = scale != self.scale, scale
        return changed
