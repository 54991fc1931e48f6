"""Differential-drive base: drives along its x axis and turns about its z axis.

The control is (v, ω) [m/s, rad/s], the configuration (x, y, θ) [m, m, rad]. In its own frame the base is a kinematic
chain of a prismatic joint along x and a revolute joint about z, both at zero, so that a point p of the footprint moves
at v e_x + ω e_z × p. With discs off the axle every barrier row also depends on ω, and the filter steers instead of only
braking.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import cos, sin, sqrt

import numpy as np
from numpy.typing import NDArray

from dualbrain.robots.model import (
    Bound,
    CollisionSphere,
    Gripper,
    Joint,
    Link,
    RobotModel,
    SelfCollisionPairs,
    Tool,
    TrackingErrorModel,
    Vector,
)

Array = NDArray[np.float64]

UNUSED_JOINT_RANGE = 10.0
"""Range of the two joints [m, rad]; they are always at zero, so the range limits must never be active."""
QUATERNION_Z_TO_X = (sqrt(0.5), 0.0, sqrt(0.5), 0.0)
QUATERNION_X_TO_Z = (sqrt(0.5), 0.0, -sqrt(0.5), 0.0)


def make_differential_base(
    name: str,
    discs: Sequence[tuple[float, float, float]],
    *,
    speed: Bound,
    turn_rate: Bound,
    acceleration: Bound,
    turn_acceleration: Bound,
    tracking: TrackingErrorModel,
    period: float = 0.02,
    licence: str = "Apache-2.0",
    source: str = "given by the user",
) -> RobotModel:
    """Robot model of a base whose footprint is covered by `discs` (x, y, radius) [m] in the frame of the base.

    Most discs should be off the axle (x ≠ 0): turning cannot move a disc on the axle away from an obstacle.
    """
    none = Bound(0.0, "m", "no gripper")
    return RobotModel(
        name=name,
        source=source,
        licence=licence,
        joints=(
            _joint("drive", QUATERNION_Z_TO_X, "prismatic", speed, acceleration),
            _joint("turn", QUATERNION_X_TO_Z, "revolute", turn_rate, turn_acceleration),
        ),
        links=(Link(name="base", frame=2, group="base"),),
        spheres=tuple(CollisionSphere("base", (x, y, 0.0), radius) for x, y, radius in discs),
        self_pairs=SelfCollisionPairs((), ()),
        tool=Tool("base", (0.0, 0.0, 0.0)),
        gripper=Gripper(opening=none, force=none, force_min=none, pad_below_tool=0.0, finger_thickness=0.0),
        home=(0.0, 0.0, 0.0),
        tracking=tracking,
        period=period,
        tool_speed=speed,
        base="differential",
    )


def base_pose(q: Array) -> tuple[Array, Vector]:
    """Rotation (3, 3) and position (3,) of the base at q = (x, y, θ)."""
    c, s = cos(q[2]), sin(q[2])
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]), (float(q[0]), float(q[1]), 0.0)


def integrate_configuration(q: Array, u: Array, dt: float) -> Array:
    """Configuration (n + 1,) after `dt` [s] at constant u = (v, ω, …), exact along the arc."""
    base = integrate_arc(float(q[0]), float(q[1]), float(q[2]), float(u[0]), float(u[1]), dt)
    return np.array([*base, *(q[3:] + dt * u[2:])])


def integrate_arc(x: float, y: float, heading: float, v: float, w: float, dt: float) -> Vector:
    """Configuration (x, y, heading) of a base after `dt` [s] at constant (v, w), exact along the arc."""
    half = 0.5 * w * dt
    chord = v * dt * (sin(half) / half if abs(half) > 1e-9 else 1.0)
    return x + chord * cos(heading + half), y + chord * sin(heading + half), heading + w * dt


def control_displacement(before: Array, after: Array) -> Array:
    """Integral (n,) of the control between two configurations (n + 1,): along the heading, about z, other joints.

    A sideways slip of the base is not included.
    """
    x, y, turn, *rest = (after - before).tolist()
    heading = float(before[2]) + 0.5 * turn
    return np.array([x * cos(heading) + y * sin(heading), turn, *rest])


def _joint(
    name: str, quaternion: tuple[float, float, float, float], kind: str, speed: Bound, acceleration: Bound
) -> Joint:
    unit = "m" if kind == "prismatic" else "rad"
    lower, upper = (
        Bound(side * UNUSED_JOINT_RANGE, unit, "never reached: the base frame moves along") for side in (-1.0, 1.0)
    )
    return Joint(
        name=name,
        translation=(0.0, 0.0, 0.0),
        quaternion=quaternion,
        lower=lower,
        upper=upper,
        velocity=speed,
        acceleration=acceleration,
        kind="prismatic" if kind == "prismatic" else "revolute",
    )
