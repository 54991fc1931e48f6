"""A body as one controller drives it: with its control period, and no faster than it may."""

from __future__ import annotations

from collections.abc import Sequence

import msgspec

from dualbrain.errors import ConfigurationError
from dualbrain.robots.model import Bound, Joint, RobotModel

MAX_PERIOD = 0.01
"""[s] Beyond it the acceleration box is so wide that more pairs could bind in one step than the kernel has room for."""


def derate(
    robot_model: RobotModel, *, period: float | None = None, max_speed: float | Sequence[float] | None = None
) -> RobotModel:
    """`body` under a controller with a `period` [s] and joint velocities up to `speed` [rad/s], one or one a joint.

    The filter must be called once in each period, and its answer must reach the joints unclipped: a limit that the
    drive has and the filter does not know of breaks its promise. Up to 4 ms there is room for every row of an arm at
    full speed; beyond, it may be stopped now and then (`Reason.ROW_OVERFLOW`).

    Raises:
        InvalidSetup: the period is not within (0, 0.01], or a speed not above 0 and within the body's own limit.
    """
    changed = robot_model
    if period is not None:
        if not 0.0 < period <= MAX_PERIOD:
            raise ConfigurationError(
                "control period [s]",
                got=period,
                allowed=f"above 0, at most {MAX_PERIOD}",
                fix="A slower policy may hold its wish; the filter must run faster.",
            )
        changed = msgspec.structs.replace(changed, period=period)
    if max_speed is not None:
        speeds = (
            [float(max_speed)] * robot_model.n
            if isinstance(max_speed, (int, float))
            else [float(value) for value in max_speed]
        )
        joints = tuple(_derate_joint(joint, value) for joint, value in zip(robot_model.joints, speeds, strict=True))
        changed = msgspec.structs.replace(changed, joints=joints)
    return changed


def _derate_joint(joint: Joint, speed: float) -> Joint:
    if not 0.0 < speed <= joint.velocity.value * (1.0 + 1e-6):
        allowed = f"above 0, at most {joint.velocity.value:g}"
        raise ConfigurationError(f"velocity limit of {joint.name} [rad/s]", got=speed, allowed=allowed)
    bound = Bound(speed, joint.velocity.unit, "controller's own limit")
    return msgspec.structs.replace(joint, velocity=bound)
