"""Box of joint accelerations that keeps the position, velocity and acceleration limits of every joint exactly."""

from __future__ import annotations

import msgspec
import numpy as np
from numpy.typing import NDArray

from dualbrain.robots.model import RobotModel

Array = NDArray[np.float64]


class JointLimits(msgspec.Struct, frozen=True, eq=False):
    """Limits of all joints, each (n,), in rad, rad/s and rad/s² (m for slides)."""

    lower: Array
    upper: Array
    velocity: Array
    acceleration: Array


def joint_limits(robot_model: RobotModel) -> JointLimits:
    """The joint limits of the robot model as arrays."""
    rows = [(j.lower.value, j.upper.value, j.velocity.value, j.acceleration.value) for j in robot_model.joints]
    return JointLimits(*np.array(rows).T)


def acceleration_box(limits: JointLimits, q: Array, v: Array, dt: float, recovery: float) -> tuple[Array, Array]:
    """Lower and upper bounds (n,) of the acceleration that is held for the next dt [s].

    Within the bounds each joint can stop before its limit from the next state on, and does not pass it before then
    (Del Prete, "Joint position and velocity bounds in discrete-time acceleration/torque control of robot manipulators",
    RA-L 2018). With d = q_max − q the next velocity is at most

        v⁺ = −a dt/2 + sqrt((a dt/2)² + 2a (d − v dt/2))   where d ≥ v dt/2, so that q⁺ + v⁺²/(2a) ≤ q_max,
        v⁺ = v − v² dt/(2d)                               else: the joint turns around within the step.

    A joint beyond its limit returns at min(`recovery`, d/dt) [rad/s]; a joint that is too fast to slow down brakes at
    its acceleration limit. Guarantee: lower ≤ upper, both within the acceleration limits.
    """
    upper = _max_acceleration(limits.upper - q, v, limits, dt, recovery)
    lower = -_max_acceleration(q - limits.lower, -v, limits, dt, recovery)
    return np.minimum(lower, upper), np.maximum(upper, np.minimum(lower, upper))


def _max_acceleration(d: Array, v: Array, limits: JointLimits, dt: float, recovery: float) -> Array:
    a, half = limits.acceleration, 0.5 * limits.acceleration * dt
    room = d - 0.5 * v * dt
    ahead = -half + np.sqrt(half**2 + 2.0 * a * np.maximum(room, 0.0))
    turning = v - 0.5 * v * v * dt / np.maximum(d, 1e-12)
    back = np.maximum(-recovery, d / dt)
    fastest = np.where(d < 0.0, back, np.where(room >= 0.0, ahead, turning))
    return np.clip((np.minimum(fastest, limits.velocity) - v) / dt, -a, a)
