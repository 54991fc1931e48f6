"""Action spaces: from the action of a policy to a nominal control, and from the safe motion back to an action."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from dualbrain.safety.cbf.filter import SafetyFilter, ToolState
from dualbrain.safety.integration.policy_guard.action_layout import Layout

Array = NDArray[np.float64]

ROUNDING = 1e-6
"""Share of a velocity limit by which a control at the limit may exceed it by rounding."""


@dataclass(slots=True, kw_only=True)
class GuardedArm:
    """The arm during one action of a policy.

    `q`, `v` (n,) [rad, rad/s] are the joint state at its beginning, and `start` (n,) is the commanded configuration
    then. The safe control moves the commanded configuration to `target` (n,) within the time `elapsed` [s].
    `velocity_limits` (n,) [rad/s] are those of the robot model. `shortened`: whether a nominal control was slower than
    the action asks for, because of these limits or of a singularity; the action then never passes unchanged.
    """

    safety: SafetyFilter
    velocity_limits: Array
    q: Array
    v: Array
    start: Array
    target: Array
    elapsed: float = 0.0
    shortened: bool = False

    @property
    def period(self) -> float:
        """The period of the filter [s]."""
        return self.safety.robot_model.period

    @property
    def velocity(self) -> Array:
        """The mean velocity (n,) [rad/s] of the commanded configuration."""
        return (self.target - self.start) / max(self.elapsed, self.period)

    def tool(self) -> ToolState:
        """The tool at the commanded configuration."""
        return self.safety.tool(self.target)

    def tool_at_start(self) -> ToolState:
        """The tool at the commanded configuration at which the action began."""
        return self.safety.tool(self.start)


class ActionGoal(Protocol):
    """The motion that one action asks for."""

    def control(self, arm: GuardedArm, remaining: float) -> Array:
        """The nominal control (n,) [rad/s] that completes the motion in `remaining` [s]."""
        ...

    def command(self, arm: GuardedArm) -> Array:
        """The values, in SI units and in the layout of the action, that command the motion of `arm` so far."""
        ...

    def is_reached(self, arm: GuardedArm) -> bool:
        """Whether the motion of `arm` so far is the one of the action, which may then pass unchanged."""
        ...


class ActionSpace(Protocol):
    """The meaning of a policy's actions."""

    @property
    def layout(self) -> Layout:
        """Entries and units of the values in the action."""
        ...

    @property
    def commands_velocity(self) -> bool:
        """Whether the joints receive the safe velocity; else the measured velocity counts as the last control."""
        ...

    @property
    def follows_position(self) -> bool:
        """Whether the robot follows the commanded configuration; else every action begins at the measured one."""
        ...

    @property
    def curves(self) -> bool:
        """Whether the motion of one action may curve between its ends, because the values are not joint values."""
        ...

    def count(self, n: int) -> int:
        """The number of values for an arm with n joints."""
        ...

    def goal(self, values: Array, arm: GuardedArm) -> ActionGoal | str:
        """The motion that `values`, in SI units, ask for, or why they ask for none."""
        ...

    def rest(self, arm: GuardedArm) -> ActionGoal:
        """The motion that ends at the commanded configuration."""
        ...

    def standstill(self, last: Array | None, n: int) -> Array | None:
        """The values that stop an arm with n joints whose joint state is unknown, after the `last` command.

        None if there are none.
        """
        ...


def limit_speed(u: Array, arm: GuardedArm) -> Array:
    """`u` (n,), scaled so that no joint exceeds its velocity limit: the direction of the motion remains."""
    excess = float(np.max(np.abs(u) / arm.velocity_limits, initial=0.0))
    arm.shortened = arm.shortened or excess > 1.0 + ROUNDING
    return u / excess if excess > 1.0 else u
