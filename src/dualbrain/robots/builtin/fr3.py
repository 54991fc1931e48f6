"""The facts of a Franka Research 3 with the Franka hand: the Panda's frames and housings, its own limits.

The maker gives the FR3's velocity limits as functions of the joint's position (libfranka, rate_limiting.h), and beside
them rectangles of position and velocity that lie inside; these are the rectangles. Compared with the documentation of
2025-08-14 and with libfranka of 2026-06-17: the same in all figures.
"""

from __future__ import annotations

from dualbrain.robots.builtin import panda
from dualbrain.robots.builtin.panda import (
    ALLOWED_PAIRS,
    GRIPPER,
    HOME,
    LINK_COVERS,
    PERIOD,
    TOOL,
    TOOL_SPEED,
    links,
    mirror_centres,
    part_mesh,
)
from dualbrain.robots.model import Bound, Joint

__all__ = [
    "LINK_COVERS",
    "GRIPPER",
    "HOME",
    "LICENCE",
    "PERIOD",
    "SOURCE",
    "ALLOWED_PAIRS",
    "TOOL",
    "TOOL_SPEED",
    "joints",
    "links",
    "mirror_centres",
    "part_mesh",
]

SOURCE: str = (
    "limits: Franka Robotics FCI documentation, limits of the Franka Research 3; frames and housings as the Panda's: "
    + panda.SOURCE
)
LICENCE: str = panda.LICENCE
FCI_RECTANGLE_SOURCE = (
    "Franka FCI documentation, limits for Franka Research 3: suggested position-velocity rectangular limits"
)
FCI_ACCELERATION_SOURCE = "Franka FCI documentation, limits for Franka Research 3; libfranka kMaxJointAcceleration"
FCI_JERK_SOURCE = "Franka FCI documentation, limits for Franka Research 3; libfranka kMaxJointJerk"

# of every joint: from, to [rad], and how fast [rad/s]
POSITION_VELOCITY_LIMITS = (
    (-2.3093, 2.3093, 2.0),
    (-1.5133, 1.5133, 1.0),
    (-2.4937, 2.4937, 1.5),
    (-2.7478, -0.4461, 1.25),
    (-2.4800, 2.4800, 3.0),
    (0.8521, 4.2094, 1.5),
    (-2.6895, 2.6895, 3.0),
)
ACCELERATION_LIMIT, JERK_LIMIT = 10.0, 5000.0
"""Of every joint [rad/s², rad/s³]."""


def joints() -> tuple[Joint, ...]:
    """The Panda's seven joints with the FR3's limits and the provenance of each."""
    return tuple(
        Joint(
            name=f"fr3_joint{i}",
            translation=joint.translation,
            quaternion=joint.quaternion,
            lower=Bound(lower, "rad", f"{FCI_RECTANGLE_SOURCE}: fr3_joint{i}"),
            upper=Bound(upper, "rad", f"{FCI_RECTANGLE_SOURCE}: fr3_joint{i}"),
            velocity=Bound(velocity, "rad/s", f"{FCI_RECTANGLE_SOURCE}: fr3_joint{i}"),
            acceleration=Bound(ACCELERATION_LIMIT, "rad/s^2", FCI_ACCELERATION_SOURCE),
            jerk=Bound(JERK_LIMIT, "rad/s^3", FCI_JERK_SOURCE),
        )
        for i, (joint, (lower, upper, velocity)) in enumerate(
            zip(panda.joints(), POSITION_VELOCITY_LIMITS, strict=True), start=1
        )
    )
