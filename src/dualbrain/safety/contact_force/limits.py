"""Limits of the contact force, with the provenance of each value."""

from __future__ import annotations

import msgspec

from dualbrain.robots.model import Bound

ISO_TS_15066_SMALLEST_FORCE = Bound(65.0, "N", "ISO/TS 15066:2016, table A.2: quasi-static contact, face")
"""The smallest force that the specification tolerates on any region of the body; for comparison only."""


class ContactForceLimits(msgspec.Struct, frozen=True, kw_only=True):
    """Limits of the estimated contact force.

    - `unexpected`: force without a contact permit that stops the arm.
    - `permitted`: force of a permitted contact at which the permitted approach speed becomes zero.
    - `stop_factor`: multiple of `permitted` that stops the arm.
    - `full_speed_share`: share of `permitted` below which the permitted speed is not reduced.
    - `deceleration`: rate at which the permitted speed changes at most, so that the filter can follow it.
    """

    unexpected: Bound = Bound(20.0, "N", "site policy; below a third of the smallest force of ISO/TS 15066")
    permitted: Bound = Bound(40.0, "N", "site policy; below the smallest force of ISO/TS 15066")
    stop_factor: Bound = Bound(1.5, "", "site policy; 60 N with the default of `permitted`")
    full_speed_share: Bound = Bound(0.25, "", "above the error of the estimate on the packaged robots")
    deceleration: Bound = Bound(1.0, "m/s^2", "half of the braking along a row that `SpeedAndSeparation` assumes")


def stop_force(limits: ContactForceLimits, *, permitted: bool) -> float:
    """The force [N] above which the arm stops, with or without a contact permit."""
    return limits.permitted.value * limits.stop_factor.value if permitted else limits.unexpected.value
