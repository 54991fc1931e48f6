"""The interface of a compared guard, and the absence of one."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from benchmarks.guards.robot_interface import RobotInterface

Array = NDArray[np.float64]


class BenchmarkedGuard(Protocol):
    """A guard for one episode, between the policy and the interface of the arm."""

    def begin(self, action: Array, q: Array, now: float) -> None:
        """A new joint position target (n,) [rad] of the policy at the measured posture q (n,)."""
        ...

    def velocity(self, q: Array, v: Array, now: float) -> Array:
        """The velocity (n,) [rad/s] for the next period at the measured joint state."""
        ...


@runtime_checkable
class ClosableGuard(Protocol):
    """A guard that holds a process or a renderer."""

    def close(self) -> None:
        """Release it."""
        ...


class TargetGuard:
    """A guard that replaces the target of each action once; without a subclass it passes every target on."""

    def __init__(self, interface: RobotInterface, duration: float) -> None:
        """Command `interface`; an action lasts `duration` [s]."""
        self._interface, self._duration = interface, duration
        self._velocity = np.zeros_like(interface.u)

    def begin(self, action: Array, q: Array, now: float) -> None:
        """Take the safe target for `action`."""
        del now
        self._velocity = self._interface.velocity_towards(self.safe_target(action, q), self._duration)

    def velocity(self, q: Array, v: Array, now: float) -> Array:
        """The velocity with which the action ends in its target."""
        del q, v, now
        return self._velocity

    def safe_target(self, action: Array, q: Array) -> Array:
        """The target that is executed instead of `action`."""
        del q
        return action
