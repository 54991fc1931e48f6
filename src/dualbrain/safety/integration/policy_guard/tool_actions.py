"""Action spaces of the tool: twists, and poses that are absolute or relative.

A twist V (6,) of the tool becomes the joint velocity u = Σ gᵢ vᵢ uᵢᵀ V with the singular values σᵢ and vectors uᵢ, vᵢ
of the Jacobian. The gain gᵢ is 1/σᵢ above σ₀ = `SINGULAR`, and σᵢ / (σᵢ² + λ² (1 − σᵢ²/σ₀²)) with the damping λ =
`DAMPING` below. An action passes unchanged only if neither the damping nor a speed limit made its motion slower. The
guarantee holds for the joint motion that the guard computes. A robot that resolves the returned pose by itself may move
its elbow differently; send it `PolicyGuard.target` or the joint velocity instead where its interface takes them.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from dualbrain.core.geometry.rotations import matrix_to_quaternion, quaternion_to_matrix, rotation_error
from dualbrain.core.geometry.validation import QUATERNION_TOLERANCE
from dualbrain.safety.cbf.filter import ToolState
from dualbrain.safety.integration.policy_guard.action_layout import ActionLayout, Layout, check_option
from dualbrain.safety.integration.policy_guard.action_space import ActionGoal, GuardedArm, limit_speed

Array = NDArray[np.float64]
Rotation = Literal["none", "rotation_vector", "quaternion"]
Frame = Literal["world", "tool"]

SINGULAR = 0.04
"""Singular value σ₀ of the Jacobian [m, rad] below which its inverse is damped."""
DAMPING = 0.01
"""Damping λ [m, rad] of the inverse of the Jacobian at a singularity."""
LOST_TWIST = 1e-6
"""Part of a twist [m/s, rad/s] that the damping may take away by rounding."""
TWIST_TOLERANCE = 1e-3
"""Difference of two twists [m/s, rad/s], from the curved path of the joints, up to which they are the same motion."""
FRAMES: tuple[Frame, ...] = ("world", "tool")
ROTATION_VALUES = {"none": 0, "rotation_vector": 3, "quaternion": 4}


@dataclass(frozen=True, slots=True, kw_only=True)
class ToolTwist:
    """Actions are the linear [m/s] and, with `angular`, the angular velocity [rad/s] of the tool in axes of `frame`."""

    layout: Layout = field(default_factory=ActionLayout)
    angular: bool = True
    frame: Frame = "world"
    commands_velocity: bool = field(default=True, init=False)
    follows_position: bool = field(default=False, init=False)
    curves: bool = field(default=True, init=False)

    def __post_init__(self) -> None:
        """Check the options; raises `ConfigurationError`."""
        check_option("ToolTwist.frame", self.frame, FRAMES)

    def count(self, n: int) -> int:
        """Three linear velocities, and three angular ones."""
        del n
        return 6 if self.angular else 3

    def goal(self, values: Array, arm: GuardedArm) -> ActionGoal:
        """A motion at constant twist."""
        del arm
        return _TwistGoal(values, self.frame)

    def rest(self, arm: GuardedArm) -> ActionGoal:
        """No motion."""
        return self.goal(np.zeros(self.count(len(arm.v))), arm)

    def standstill(self, last: Array | None, n: int) -> Array | None:
        """Zero twist."""
        del last
        return np.zeros(self.count(n))


@dataclass(frozen=True, slots=True, kw_only=True)
class ToolPose:
    """Actions are poses of the tool: position [m] and rotation, with `delta` relative to the commanded pose.

    `rotation`: a rotation vector [rad], a unit quaternion (w, x, y, z), or "none": the tool keeps its rotation.
    Relative poses are in the axes of `frame`; absolute ones in those of the world, which are those of the robot's base.
    """

    layout: Layout = field(default_factory=ActionLayout)
    rotation: Rotation = "rotation_vector"
    delta: bool = False
    frame: Frame = "world"
    commands_velocity: bool = field(default=True, init=False)
    follows_position: bool = field(default=True, init=False)
    curves: bool = field(default=True, init=False)

    def __post_init__(self) -> None:
        """Check the options; raises `ConfigurationError`."""
        check_option("ToolPose.frame", self.frame, FRAMES)
        check_option("ToolPose.rotation", self.rotation, ROTATION_VALUES)

    def count(self, n: int) -> int:
        """Three coordinates and the numbers of the rotation."""
        del n
        return 3 + ROTATION_VALUES[self.rotation]

    def goal(self, values: Array, arm: GuardedArm) -> ActionGoal | str:
        """A motion to a pose, or why the quaternion is no rotation."""
        if problem := self._quaternion_problem(values[3:]):
            return problem
        start = arm.tool_at_start()
        turn = self._turn(values[3:])
        if not self.delta:
            rotation = start.rotation if turn is None else turn
            return _PoseGoal(values[:3], rotation, self)
        axes = start.rotation if self.frame == "tool" else np.eye(3)
        rotation = start.rotation if turn is None else axes @ turn @ axes.T @ start.rotation
        return _PoseGoal(start.position + axes @ values[:3], rotation, self)

    def rest(self, arm: GuardedArm) -> ActionGoal:
        """The commanded pose."""
        tool = arm.tool_at_start()
        return _PoseGoal(tool.position, tool.rotation, self)

    def standstill(self, last: Array | None, n: int) -> Array | None:
        """No change, or the last commanded pose."""
        if not self.delta:
            return last
        values = np.zeros(self.count(n))
        values[3:4] = self.rotation == "quaternion"
        return values

    def _turn(self, values: Array) -> Array | None:
        """The rotation matrix of an action; None for one without a rotation."""
        if self.rotation == "none":
            return None
        if self.rotation == "quaternion":
            return quaternion_to_matrix(values.tolist())
        return rotation_matrix(values)

    def _quaternion_problem(self, values: Array) -> str:
        """Why the last `values` are no rotation, or ""."""
        length = float(np.linalg.norm(values))
        if self.rotation != "quaternion" or abs(length - 1.0) <= QUATERNION_TOLERANCE:
            return ""
        return (
            f"the quaternion has the length {length:.3g}, allowed is 1 within {QUATERNION_TOLERANCE:g}; the arm comes "
            "to rest. Remedy: divide the quaternion (w, x, y, z) of the policy by its length"
        )

    def values(self, tool: ToolState, start: ToolState) -> Array:
        """The values of the pose `tool`, for a relative action of its change since `start`."""
        axes = start.rotation if self.delta and self.frame == "tool" else np.eye(3)
        position = axes.T @ (tool.position - start.position) if self.delta else tool.position
        rotation = axes.T @ tool.rotation @ start.rotation.T @ axes if self.delta else tool.rotation
        if self.rotation == "none":
            return position
        if self.rotation == "quaternion":
            return np.concatenate([position, matrix_to_quaternion(rotation)])
        return np.concatenate([position, rotation_vector(rotation)])


@dataclass(frozen=True, slots=True)
class _TwistGoal:
    twist: Array
    frame: Frame

    def control(self, arm: GuardedArm, remaining: float) -> Array:
        del remaining
        axes = arm.tool().rotation if self.frame == "tool" else np.eye(3)
        return resolve(np.concatenate([axes @ part for part in self.twist.reshape(-1, 3)]), arm)

    def command(self, arm: GuardedArm) -> Array:
        time, start, tool = max(arm.elapsed, arm.period), arm.tool_at_start(), arm.tool()
        axes = start.rotation if self.frame == "tool" else np.eye(3)
        linear = axes.T @ (tool.position - start.position) / time
        if len(self.twist) == 3:
            return linear
        return np.concatenate([linear, axes.T @ rotation_error(start.rotation, tool.rotation) / time])

    def is_reached(self, arm: GuardedArm) -> bool:
        return not arm.shortened and bool(np.abs(self.command(arm) - self.twist).max() <= TWIST_TOLERANCE)


@dataclass(frozen=True, slots=True)
class _PoseGoal:
    position: Array
    rotation: Array
    space: ToolPose

    def control(self, arm: GuardedArm, remaining: float) -> Array:
        return resolve(self._error(arm) / max(remaining, arm.period), arm)

    def command(self, arm: GuardedArm) -> Array:
        return self.space.values(arm.tool(), arm.tool_at_start())

    def is_reached(self, arm: GuardedArm) -> bool:
        rates = self._error(arm) / max(arm.elapsed, arm.period)
        return not arm.shortened and bool(np.abs(rates).max() <= TWIST_TOLERANCE)

    def _error(self, arm: GuardedArm) -> Array:
        """The motion (6,) that is left."""
        tool = arm.tool()
        return np.concatenate([self.position - tool.position, rotation_error(tool.rotation, self.rotation)])


def resolve(twist: Array, arm: GuardedArm) -> Array:
    """The joint velocity (n,) that moves the tool at the commanded configuration with `twist`, (6,) or linear (3,)."""
    J = arm.tool().jacobian[: len(twist)]
    left, sigma, right = np.linalg.svd(J, full_matrices=False)
    damping = DAMPING**2 * np.maximum(0.0, 1.0 - (sigma / SINGULAR) ** 2)
    u = right.T @ (sigma / (sigma**2 + damping) * (left.T @ twist))
    arm.shortened = arm.shortened or bool(np.abs(twist - J @ u).max() > LOST_TWIST)
    return limit_speed(u, arm)


def rotation_vector(rotation: Array) -> Array:
    """The rotation vector (3,) [rad] of a rotation matrix; through its quaternion, which is exact near half a turn."""
    w, *axis = matrix_to_quaternion(rotation)
    sine = float(np.linalg.norm(axis))
    return 2.0 * np.arctan2(sine, w) / sine * np.asarray(axis) if sine > 0.0 else np.zeros(3)


def rotation_matrix(vector: Array) -> Array:
    """The rotation (3, 3) by the rotation vector (3,) [rad]."""
    angle = float(np.linalg.norm(vector))
    if angle < 1e-12:
        return np.eye(3)
    half = 0.5 * angle
    return quaternion_to_matrix((float(np.cos(half)), *(np.sin(half) / angle * vector).tolist()))
