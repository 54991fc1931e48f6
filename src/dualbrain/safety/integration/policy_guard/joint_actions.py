"""Action spaces of the joints: velocities, and positions that are absolute or relative."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from dualbrain.safety.integration.policy_guard.action_layout import ActionLayout, Layout, check_option
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
    curves: bool = field(default=False, init=False)

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

    With `stops` the speed is limited so that the joints can stop at the position within their acceleration limits:
    positions that are far away are then reached without overshoot, and moving ones are followed v²/2a later.
    """

    layout: Layout = field(default_factory=ActionLayout)
    delta: bool = False
    reference: Literal["commanded", "measured"] = "commanded"
    stops: bool = False
    commands_velocity: bool = field(default=True, init=False)
    follows_position: bool = field(default=True, init=False)
    curves: bool = field(default=False, init=False)

    def __post_init__(self) -> None:
        """Check the options; raises `ConfigurationError`."""
        check_option("JointPosition.reference", self.reference, ("commanded", "measured"))

    def count(self, n: int) -> int:
        """One position per joint."""
        return n

    def goal(self, values: Array, arm: GuardedArm) -> ActionGoal:
        """A motion to a position."""
        if not self.delta:
            return _PositionGoal(values, np.zeros_like(values), self.stops)
        origin = arm.q if self.reference == "measured" else arm.start
        return _PositionGoal(origin + values, origin, self.stops)

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
    """A position, the origin of the values of the action, and whether the joints stop there."""

    position: Array
    origin: Array
    stops: bool = False

    def control(self, arm: GuardedArm, remaining: float) -> Array:
        way = self.position - arm.target
        u = limit_speed(way / max(remaining, arm.period), arm)
        return u * _stopping_share(way, u, arm) if self.stops else u

    def command(self, arm: GuardedArm) -> Array:
        return arm.target - self.origin

    def is_reached(self, arm: GuardedArm) -> bool:
        return not arm.shortened and bool(np.abs(arm.target - self.position).max() <= POSITION_TOLERANCE)


def _stopping_share(way: Array, u: Array, arm: GuardedArm) -> float:
    """The largest share of `u` (n,) [rad/s], at most 1, from which every joint can stop within its `way` (n,) [rad].

    At the constant deceleration a a joint stops within v dt/2 + v²/2a, dt being the period.
    """
    a = np.array([joint.acceleration.value for joint in arm.safety.robot_model.joints])
    half_step = 0.5 * a * arm.period
    fastest = np.sqrt(half_step**2 + 2.0 * a * np.abs(way)) - half_step
    moving = np.abs(u) > 0.0
    return float(np.min(fastest[moving] / np.abs(u[moving]), initial=1.0))
