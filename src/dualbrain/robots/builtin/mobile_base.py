"""The facts of a small differential-drive base, of dualbrain's own: figures of an indoor platform."""

from __future__ import annotations

from math import hypot

from dualbrain.robots.differential_drive import differential_base
from dualbrain.robots.model import Body, Bound, Tracking

POLICY = "site policy; an indoor platform of dualbrain's own"
HALF_LENGTH, HALF_BREADTH, HEIGHT = 0.22, 0.18, 0.30
"""The housing [m]: a box, the axle under its middle."""
DISC_X, DISC_Y = 0.12, 0.09
"""Where the four discs of the footprint lie [m], ahead of the axle and behind it: none can only be braked for."""
RADIUS = round(max(hypot(HALF_LENGTH - DISC_X, HALF_BREADTH - DISC_Y), hypot(DISC_X, DISC_Y)) + 5e-4, 4)
"""So large that the four discs cover corners, sides and middle of the rectangle [m]."""


def body(tracking: Tracking) -> Body:
    """The base with the tracking model that was identified on its plant."""
    discs = [(x, y, RADIUS) for x in (-DISC_X, DISC_X) for y in (-DISC_Y, DISC_Y)]
    return differential_base(
        "base", discs, speed=Bound(0.6, "m/s", POLICY), turn=Bound(1.5, "rad/s", POLICY),
        acceleration=Bound(0.8, "m/s^2", POLICY), turn_acceleration=Bound(3.0, "rad/s^2", POLICY),
        tracking=tracking, period=0.02, source="robots/builtin/mobile_base.py",
    )  # fmt: skip
