"""Definition of a small differential-drive base with the dimensions of an indoor platform, designed for dualbrain."""

from __future__ import annotations

from math import hypot

from dualbrain.robots.differential_drive import make_differential_base
from dualbrain.robots.model import Bound, RobotModel, TrackingErrorModel

LIMITS_SOURCE = "site policy; an indoor platform of dualbrain's own"
HALF_LENGTH, HALF_WIDTH, HEIGHT = 0.22, 0.18, 0.30
"""The housing [m], a box whose centre is above the axle."""
DISC_OFFSET_X, DISC_OFFSET_Y = 0.12, 0.09
"""Offsets of the four discs of the footprint [m]: all are off the axle, so that turning moves each of them."""
DISC_RADIUS = round(
    max(hypot(HALF_LENGTH - DISC_OFFSET_X, HALF_WIDTH - DISC_OFFSET_Y), hypot(DISC_OFFSET_X, DISC_OFFSET_Y)) + 5e-4, 4
)
"""Radius with which the four discs cover corners, sides and middle of the rectangle [m]."""


def make_model(tracking: TrackingErrorModel) -> RobotModel:
    """The model of the base with the identified tracking-error model."""
    discs = [(x, y, DISC_RADIUS) for x in (-DISC_OFFSET_X, DISC_OFFSET_X) for y in (-DISC_OFFSET_Y, DISC_OFFSET_Y)]
    return make_differential_base(
        "base",
        discs,
        speed=Bound(0.6, "m/s", LIMITS_SOURCE),
        turn_rate=Bound(1.5, "rad/s", LIMITS_SOURCE),
        acceleration=Bound(0.8, "m/s^2", LIMITS_SOURCE),
        turn_acceleration=Bound(3.0, "rad/s^2", LIMITS_SOURCE),
        tracking=tracking,
        period=0.02,
        source="robots/builtin/mobile_base.py",
    )
