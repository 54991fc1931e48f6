"""Limits of the contact force, with the provenance of each value."""

from __future__ import annotations

import msgspec

from dualbrain.robots.model import Bound

ISO_TS_15066_SMALLEST_FORCE = Bound(65.0, "N", "ISO/TS 15066:2016, table A.2: quasi-static contact, face")
"""The smallest force that the specification tolerates on any region of the body; for comparison only."""


class ContactForceLimits(msgspec.Struct, frozen=True, kw_only=True):
    """Limits of the estimated contact force.

    - `unexpected`: force without a contact permit that stops the arm.
    - `permitted`: force of a permitted contact at which the permitted approach speed becomes zero, and above which the
      arm yields until `release_share` of it is left.
    - `stop_factor`: multiple of `permitted` that stops the arm if it lasts for `stop_time` [s].
    - `full_speed_share`: share of `permitted` below which the permitted speed is not reduced.
    - `deceleration`: rate at which the permitted speed falls at most, so that the filter can follow it. `recovery`:
      rate at which it rises again, so that a hand that yielded does not hit the object again at full speed.
    """

    unexpected: Bound = Bound(20.0, "N", "site policy; below a third of the smallest force of ISO/TS 15066")
    permitted: Bound = Bound(40.0, "N", "site policy; below the smallest force of ISO/TS 15066")
    stop_factor: Bound = Bound(1.5, "", "site policy; 60 N with the default of `permitted`")
    stop_time: Bound = Bound(0.05, "s", "time in which a yielding arm reduces the force of a rigid contact at 5 cm/s")
    release_share: Bound = Bound(0.5, "", "half of `permitted`, so that the arm does not alternate at one force")
    full_speed_share: Bound = Bound(0.5, "", "20 N, as `unexpected`: a push with friction stays below it")
    deceleration: Bound = Bound(1.0, "m/s^2", "half of the braking along a row that `SpeedAndSeparation` assumes")
    recovery: Bound = Bound(0.02, "m/s^2", "site policy; 2.5 s from rest to 5 cm/s")


def stop_force(limits: ContactForceLimits, *, permitted: bool) -> float:
    """The force [N] above which the arm stops, with or without a contact permit."""
    return limits.permitted.value * limits.stop_factor.value if permitted else limits.unexpected.value
