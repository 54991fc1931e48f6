"""Action space of joint torques, through the velocity that a torque causes in one period."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from dualbrain.safety.integration.policy_guard.action_layout import ActionLayout, Layout
from dualbrain.safety.integration.policy_guard.action_space import ActionGoal, GuardedArm

Array = NDArray[np.float64]

VELOCITY_TOLERANCE = 1e-4
"""Difference [rad/s] of two velocities that counts as rounding."""


class TorqueDrive(Protocol):
    """Dynamics that a torque-driven robot must provide; all arrays are (n,) in SI units."""

    def acceleration(self, q: Array, v: Array, torque: Array) -> Array:
        """Joint accelerations that `torque` causes at angles q and velocities v (forward dynamics)."""
        ...

    def track(self, q: Array, v: Array, u: Array) -> Array:
        """Torque that brings the joints from velocity v to u within one step, by computed torque or a PD law."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class JointTorque:
    """Actions are joint torques [Nm]; the nominal control is the velocity v + dt M⁻¹(τ − c − g) that they cause.

    A torque that the filter does not change passes unchanged; otherwise `drive` tracks the safe velocity. The action
    lasts one period of the filter.
    """

    drive: TorqueDrive
    layout: Layout = field(default_factory=ActionLayout)
    commands_velocity: bool = field(default=False, init=False)
    follows_position: bool = field(default=False, init=False)
    curves: bool = field(default=False, init=False)

    def count(self, n: int) -> int:
        """One torque per joint."""
        return n

    def goal(self, values: Array, arm: GuardedArm) -> ActionGoal:
        """The velocity that a torque causes."""
        caused = arm.v + arm.period * self.drive.acceleration(arm.q, arm.v, values)
        return _TorqueGoal(caused, self.drive)

    def rest(self, arm: GuardedArm) -> ActionGoal:
        """Standstill."""
        return _TorqueGoal(np.zeros_like(arm.v), self.drive)

    def standstill(self, last: Array | None, n: int) -> Array | None:
        """None: no torque stops an arm whose state is unknown."""
        del last, n
        return None


@dataclass(frozen=True, slots=True)
class _TorqueGoal:
    velocity: Array
    drive: TorqueDrive

    def control(self, arm: GuardedArm, remaining: float) -> Array:
        del arm, remaining
        return self.velocity

    def command(self, arm: GuardedArm) -> Array:
        return self.drive.track(arm.q, arm.v, arm.velocity)

    def is_reached(self, arm: GuardedArm) -> bool:
        return bool(np.allclose(arm.velocity, self.velocity, rtol=0.0, atol=VELOCITY_TOLERANCE))
