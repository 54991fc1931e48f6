"""Contact permits: which part of the robot may touch what, and how fast (design 4, row rule 5)."""

from __future__ import annotations

import msgspec


class Contact(msgspec.Struct, frozen=True):
    """The sphere group or link `robot_part` ("hand", "fingers", "held", "left_finger") may meet `obstacle`.

    The barrier rows of exactly these pairs are replaced by n'(J u − v_o) ≥ −max(`speed`, α h): no faster than `speed`
    [m/s] at contact, and no faster than the barrier would allow before.
    """

    robot_part: str
    obstacle: str
    speed: float
