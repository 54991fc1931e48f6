"""State of a simulated robot at rest: posture, fingers and grip."""

from __future__ import annotations

import msgspec


class PlantState(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The configuration (nq,) [rad; of a base x, y in m and the heading in rad], and for a gripper its fingers.

    `fingers` are the positions of the finger joints [m], `finger_setpoint` and `target_opening` the set point of their
    servo and its goal [m], `grip_force` its limit [N per finger].
    """

    configuration: tuple[float, ...]
    fingers: tuple[float, ...] = ()
    finger_setpoint: float = 0.0
    target_opening: float = 0.0
    grip_force: float = 0.0
