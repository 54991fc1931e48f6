"""Definition of the Franka Research 3 with the Franka hand: frames and housings of the Panda, limits of the FR3.

The manufacturer gives the velocity limits of the FR3 as functions of the joint position (libfranka, rate_limiting.h)
and, inside these, rectangles of position and velocity; the values here are the rectangles. They are equal to those in
the documentation of 2025-08-14 and in libfranka of 2026-06-17.
"""

from __future__ import annotations

from dualbrain.robots.builtin import panda
from dualbrain.robots.builtin.panda import (
    ALLOWED_PAIRS,
    DYNAMICS,
    FORCE_SENSING,
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
    "ALLOWED_PAIRS",
    "DYNAMICS",
    "FORCE_SENSING",
    "GRIPPER",
    "HOME",
    "LICENCE",
    "LINK_COVERS",
    "PERIOD",
    "SOURCE",
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

# lower [rad], upper [rad], velocity [rad/s] of every joint
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
"""Limits of every joint [rad/s², rad/s³]."""


def joints() -> tuple[Joint, ...]:
    """The seven joints: frames of the Panda, limits of the FR3, and the provenance of each limit."""
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
