"""The tracking model of a robot that nobody has measured yet."""

from __future__ import annotations

from dualbrain.embodiment.body import Tracking

UNKNOWN = (
    "not identified: measure how its drive follows and edit `tracking` in body.json, or give "
    "FilterConfig(tracking_error=...)"
)


def not_identified() -> Tracking:
    """No lag and no error, said to be unknown; inspect and doctor count it as missing."""
    return Tracking(0.0, 0.0, 0.0, UNKNOWN)


def is_identified(tracking: Tracking) -> bool:
    """Whether somebody measured it."""
    return tracking.provenance != UNKNOWN
