"""Action spaces of the joints: velocities, and positions that are absolute or relative."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from dualbrain.safety.integration.policy_guard.action_layout import ActionLayout, Layout
from dualbrain.safety.integration.policy_guard.action_space import ActionGoal, GuardedArm, limit_speed

Array = NDArray[np.float64]

POSITION_TOLERANCE = 1e-6
"""Distance of a joint from its goal [rad] at which the goal is reached."""


@dataclass(frozen=True, slots=True, kw_only=True)
class JointVelocity:
    """Actions are joint velocities [rad/s]."""

    layout: Layout = field(default_factory=ActionLayout)
    commands_velocity: bool = field(default=True, init=False)
    follows_position: bool = field(default=False, init=False)

    def count(self, n: int) -> int:
        """One velocity per joint."""
        return n

    def goal(self, values: Array, arm: GuardedArm) -> ActionGoal:
        """A motion at constant velocity."""
        del arm
        return _VelocityGoal(values)

    def rest(self, arm: GuardedArm) -> ActionGoal:
        """No motion."""
        return self.goal(np.zeros_like(arm.v), arm)

    def standstill(self, last: Array | None, n: int) -> Array | None:
        """Zero velocity."""
        del last
        return np.zeros(n)


@dataclass(frozen=True, slots=True, kw_only=True)
class JointPosition:
    """Actions are joint positions [rad]; with `delta` relative to the commanded or the measured position.

    A position is approached on a straight line in joint space within the period of the policy, or at the velocity limit
    if it is too far for that. The guard integrates its own commanded position, so that a servo with a constant error
    still follows the policy.
    """

    layout: Layout = field(default_factory=ActionLayout)
    delta: bool = False
    reference: Literal["commanded", "measured"] = "commanded"
    commands_velocity: bool = field(default=True, init=False)
    follows_position: bool = field(default=True, init=False)

    def count(self, n: int) -> int:
        """One position per joint."""
        return n

    def goal(self, values: Array, arm: GuardedArm) -> ActionGoal:
        """A motion to a position."""
        if not self.delta:
            return _PositionGoal(values, np.zeros_like(values))
        origin = arm.q if self.reference == "measured" else arm.start
        return _PositionGoal(origin + values, origin)

    def rest(self, arm: GuardedArm) -> ActionGoal:
        """The commanded position."""
        origin = arm.q if self.reference == "measured" else arm.start
        return _PositionGoal(arm.start, origin if self.delta else np.zeros_like(arm.start))

    def standstill(self, last: Array | None, n: int) -> Array | None:
        """No change, or the last commanded position."""
        return np.zeros(n) if self.delta else last


@dataclass(frozen=True, slots=True)
class _VelocityGoal:
    velocity: Array

    def control(self, arm: GuardedArm, remaining: float) -> Array:
        del arm, remaining
        return self.velocity

    def command(self, arm: GuardedArm) -> Array:
        return arm.velocity

    def is_reached(self, arm: GuardedArm) -> bool:
        return bool(np.abs(arm.velocity - self.velocity).max() <= POSITION_TOLERANCE / arm.period)


@dataclass(frozen=True, slots=True)
class _PositionGoal:
    """A position, and the origin of the values of the action."""

    position: Array
    origin: Array

    def control(self, arm: GuardedArm, remaining: float) -> Array:
        return limit_speed((self.position - arm.target) / max(remaining, arm.period), arm)

    def command(self, arm: GuardedArm) -> Array:
        return arm.target - self.origin

    def is_reached(self, arm: GuardedArm) -> bool:
        return bool(np.abs(arm.target - self.position).max() <= POSITION_TOLERANCE)
