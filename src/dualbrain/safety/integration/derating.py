"""A body as one controller drives it: with its control period, and no faster than it may."""

from __future__ import annotations

from collections.abc import Sequence

import msgspec

from dualbrain.errors import InvalidSetup
from dualbrain.robots.model import Body, Bound, Joint

LONGEST_PERIOD = 0.01
"""[s] Beyond it the acceleration box is so wide that more pairs could bind in one step than the kernel has room for."""


def driven(body: Body, *, period: float | None = None, speed: float | Sequence[float] | None = None) -> Body:
    """`body` under a controller with a `period` [s] and joint velocities up to `speed` [rad/s], one or one a joint.

    The filter must be called once in each period, and its answer must reach the joints unclipped: a limit that the
    drive has and the filter does not know of breaks its promise. Up to 4 ms there is room for every row of an arm at
    full speed; beyond, it may be stopped now and then (`Reason.ROW_OVERFLOW`).

    Raises:
        InvalidSetup: the period is not within (0, 0.01], or a speed not above 0 and within the body's own limit.
    """
    changed = body
    if period is not None:
        if not 0.0 < period <= LONGEST_PERIOD:
            raise InvalidSetup(
                "control period [s]", got=period, allowed=f"above 0, at most {LONGEST_PERIOD}",
                fix="A slower policy may hold its wish; the filter must run faster.",
            )  # fmt: skip
        changed = msgspec.structs.replace(changed, period=period)
    if speed is not None:
        speeds = [float(speed)] * body.n if isinstance(speed, (int, float)) else [float(value) for value in speed]
        joints = tuple(_slower(joint, value) for joint, value in zip(body.joints, speeds, strict=True))
        changed = msgspec.structs.replace(changed, joints=joints)
    return changed


def _slower(joint: Joint, speed: float) -> Joint:
    if not 0.0 < speed <= joint.velocity.value * (1.0 + 1e-6):
        allowed = f"above 0, at most {joint.velocity.value:g}"
        raise InvalidSetup(f"velocity limit of {joint.name} [rad/s]", got=speed, allowed=allowed)
    bound = Bound(speed, joint.velocity.unit, "controller's own limit")
    return msgspec.structs.replace(joint, velocity=bound)
