"""Derating of a robot model to the control period and the velocity limits of a controller."""

from __future__ import annotations

from collections.abc import Sequence

import msgspec

from dualbrain.errors import ConfigurationError
from dualbrain.robots.model import Bound, Joint, RobotModel

MAX_PERIOD = 0.01
"""Largest control period [s]. Beyond it more rows may bind in one step than the kernel has room for."""


def derate(
    robot_model: RobotModel, *, period: float | None = None, max_speed: float | Sequence[float] | None = None
) -> RobotModel:
    """`robot_model` with a control `period` [s] and velocity limits `max_speed` [rad/s], one or one per joint.

    The filter must be called once per period, and its result must reach the joints without clipping: the guarantee of
    the filter does not hold under a limit of the drive that the filter does not know. Up to 4 ms the kernel has room
    for all rows of an arm at full speed; with longer periods it may stop the arm (`Reason.ROW_OVERFLOW`).

    Raises:
        ConfigurationError: the period is not in (0, 0.01], a speed is not above 0 or exceeds the limit of the joint, or
            the number of speeds is not that of the joints.
    """
    changed = robot_model
    if period is not None:
        if not 0.0 < period <= MAX_PERIOD:
            raise ConfigurationError(
                "control period [s]",
                got=period,
                allowed=f"above 0, at most {MAX_PERIOD}",
                fix="Repeat the action of a slower policy, and run the filter at a shorter period.",
            )
        changed = msgspec.structs.replace(changed, period=period)
    if max_speed is not None:
        speeds = (
            [float(max_speed)] * robot_model.n
            if isinstance(max_speed, (int, float))
            else [float(value) for value in max_speed]
        )
        if len(speeds) != robot_model.n:
            allowed = f"one number, or {robot_model.n} for the joints"
            raise ConfigurationError("velocity limits [rad/s]", got=speeds, allowed=allowed)
        joints = tuple(_derate_joint(joint, value) for joint, value in zip(robot_model.joints, speeds, strict=True))
        changed = msgspec.structs.replace(changed, joints=joints)
    return changed


def _derate_joint(joint: Joint, speed: float) -> Joint:
    if not 0.0 < speed <= joint.velocity.value * (1.0 + 1e-6):
        allowed = f"above 0, at most {joint.velocity.value:g}"
        raise ConfigurationError(f"velocity limit of {joint.name} [rad/s]", got=speed, allowed=allowed)
    bound = Bound(speed, joint.velocity.unit, "limit of the controller")
    return msgspec.structs.replace(joint, velocity=bound)
