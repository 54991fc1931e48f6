"""Resolved-rate controller φ: maps a tool pose to a joint velocity within known constraints (paper 4.2, design 4).

u_desired = J⁺(ν − J u₀) + u₀ with damping, u₀ = k₀ (q_posture − q); ν is a twist of limited speed and acceleration that
brakes in time. u_nom is the projection of u_desired onto the rows known to φ and the box around its *own* previous
nominal control. φ never starts from the measured velocity, so that a filter that slows the arm does not reduce the
desired control.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import pi, sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dualbrain.core.geometry.rotations import rotation_error
from dualbrain.robots.interface import RobotState
from dualbrain.robots.model import RobotModel
from dualbrain.skills.skill import MotionModel, ToolState

Array = NDArray[np.float64]

MAX_DIRECT_ANGLE = pi / 2
"""Rotations beyond this angle [rad] may go either way; smaller rotations take the short way."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Gains:
    """Gains and limits of the tool motion.

    `position` and `rotation` [1/s] reduce the pose error. `linear_acceleration` [m/s²] and `angular_acceleration`
    [rad/s²] limit the change of the twist, `max_rotation_rate` [rad/s] its rotation. `posture` [1/s] moves the
    redundant joint toward the posture (an arm of six joints has none). `damping` [m] keeps the inverse finite at
    singular poses. `speed_fraction` is the fraction of the joint velocity limits that φ uses.
    """

    position: float = 5.0
    rotation: float = 4.0
    linear_acceleration: float = 1.0
    angular_acceleration: float = 6.0
    max_rotation_rate: float = 1.2
    posture: float = 1.0
    damping: float = 0.02
    speed_fraction: float = 0.95


class PoseError(NamedTuple):
    """Error of a tool pose: `translation` (3,) [m] and rotation vector `rotation` (3,) [rad] in the world frame."""

    translation: Array
    rotation: Array

    @property
    def distance(self) -> float:
        """Norm of `translation` [m]."""
        return sqrt(float(self.translation @ self.translation))

    @property
    def angle(self) -> float:
        """Norm of `rotation` [rad]."""
        return sqrt(float(self.rotation @ self.rotation))


def pose_error(tool: ToolState, position: Array, rotation: Array) -> PoseError:
    """The error of `tool` relative to a pose (position (3,) [m], rotation (3, 3))."""
    return PoseError(position - tool.position, rotation_error(tool.rotation, rotation))


class ResolvedRate:
    """The controller φ. State: the current twist and the last nominal control."""

    def __init__(self, robot_model: RobotModel, motion: MotionModel, gains: Gains | None = None) -> None:
        """Use `motion` for kinematics and projection."""
        self._motion = motion
        self._gains = gains or Gains()
        self._dt = robot_model.period
        self._u_max = self._gains.speed_fraction * np.array([joint.velocity.value for joint in robot_model.joints])
        self._brake = 0.6 * np.array([joint.acceleration.value for joint in robot_model.joints])
        self._damping = self._gains.damping**2
        self._posture_gain = self._gains.posture if robot_model.n > 6 else 0.0
        self._twist = np.zeros(6)
        self._u_nom = self._u_nom_prev = np.zeros(robot_model.n)

    def toward_pose(
        self,
        state: RobotState,
        tool: ToolState,
        error: PoseError,
        speed: float,
        posture: Array,
        now: float,
        *,
        stop: bool = True,
    ) -> Array:
        """u_nom (n,) [rad/s] that reduces the pose `error` at up to `speed` [m/s]; `stop` brakes at the goal."""
        turn = error.rotation
        if float(turn @ turn) > MAX_DIRECT_ANGLE**2:
            turn = nearer_rotation(turn, tool.jacobian[3:] @ (posture - state.q))
        self._update_twist(error.translation, turn, speed, stop=stop)
        return self._resolve(state, tool, posture, now)

    def toward_joints(
        self, state: RobotState, tool: ToolState, goal: Array, speed_fraction: float, speed: float, now: float
    ) -> Array:
        """u_nom (n,) [rad/s] straight through joint space to `goal` (n,) [rad].

        Joints move at up to `speed_fraction` of their velocity limits, the tool at up to `speed` [m/s].
        """
        error = goal - state.q
        remaining = float(np.max(np.abs(error) / self._u_max))
        pace = min(speed_fraction, 3.0 * remaining, sqrt(2.0 * float(np.min(self._brake / self._u_max)) * remaining))
        desired = error * (pace / remaining) if remaining > 1e-6 else error
        tool_speed = float(np.linalg.norm(tool.jacobian[:3] @ desired))
        self._twist[:] = 0.0
        return self._project(state, desired * (speed / tool_speed) if tool_speed > speed else desired, now)

    def rest(self, state: RobotState, now: float) -> Array:
        """u_nom (n,) [rad/s] that brakes to a standstill."""
        self._twist[:] = 0.0
        return self._project(state, np.zeros_like(self._u_nom), now)

    def reproject(self, state: RobotState, u: Array, now: float) -> Array:
        """The u_nom (n,) [rad/s] of this tick projected again, from the previous tick, onto rows that have changed."""
        self._u_nom = self._u_nom_prev
        return self._project(state, u, now)

    def _update_twist(self, error: Array, turn: Array, speed: float, *, stop: bool) -> None:
        """Move the twist toward the one that reduces `error` [m] and `turn` [rad], within the acceleration limits."""
        gains = self._gains
        distance = sqrt(float(error @ error))
        rate = min(speed, gains.position * distance)
        if stop:
            rate = min(rate, sqrt(1.2 * gains.linear_acceleration * distance))
        turn = gains.rotation * turn
        turning = sqrt(float(turn @ turn))
        if turning > gains.max_rotation_rate:
            turn *= gains.max_rotation_rate / turning
        linear = error * (rate / distance) if distance > 1e-9 else error
        _step_toward(self._twist[:3], linear, gains.linear_acceleration * self._dt)
        _step_toward(self._twist[3:], turn, gains.angular_acceleration * self._dt)

    def _resolve(self, state: RobotState, tool: ToolState, posture: Array, now: float) -> Array:
        drift = self._posture_gain * (posture - state.q)
        drift *= min(1.0, 0.5 / (sqrt(float(drift @ drift)) + 1e-9))
        desired = self._motion.damped_least_squares(tool.jacobian, self._damping, self._twist, drift)
        excess = float((np.abs(desired) / self._u_max).max())
        return self._project(state, desired / excess if excess > 1.0 else desired, now)

    def _project(self, state: RobotState, u_desired: Array, now: float) -> Array:
        self._u_nom_prev = self._u_nom
        self._u_nom = self._motion.project(state, u_desired, self._u_nom_prev, now)
        return self._u_nom


def nearer_rotation(turn: Array, swept: Array) -> Array:
    """The rotation vector (3,) equivalent to `turn` in the direction that is closer to `swept` (3,) [rad].

    θ e and (θ − 2π) e are the same rotation. The short way may end at a joint limit if the posture of the goal requires
    the other direction; `swept` = J_ω (q_goal − q) is the direction of the joints.
    """
    angle = sqrt(float(turn @ turn))
    other = turn * (1.0 - 2.0 * pi / angle)
    near, far = turn - swept, other - swept
    return turn if float(near @ near) <= float(far @ far) else other


def _step_toward(value: Array, target: Array, step: float) -> None:
    """Move `value` toward `target` by at most `step` in norm, in place."""
    change = target - value
    size = sqrt(float(change @ change))
    value += change * (step / size) if size > step else change
