"""Driver interface: a `RobotInterface` that waits for the next joint state and reports the faults of the arm."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from dualbrain.robots.interface import Command, RobotInterface
from dualbrain.safety.supervisor.timing import Timing


class Driver(RobotInterface, Protocol):
    """A robot with a connection of its own. The requirements on a driver are in `drivers/conformance/rules.py`.

    An open driver never raises an exception: an error of the vendor's library ends the motion (`read().drive_enabled`
    becomes False) and is reported by `faults()`.
    """

    @property
    def timing(self) -> Timing:
        """Timing of the connection: period of the states, and the thresholds for late states and ticks."""
        ...

    @property
    def watchdog(self) -> float:
        """Time [s] without a command after which the arm stops by itself; infinite if it has no watchdog."""
        ...

    def wait(self) -> None:
        """Wait for the next joint state, which `read` then returns."""
        ...

    def faults(self) -> tuple[str, ...]:
        """Reasons why the drive was switched off without a call of `stop`, as reported by the arm; else empty."""
        ...

    def close(self) -> None:
        """Stop the arm and disconnect; may be called more than once."""
        ...


def command_fault(command: Command, n_joints: int) -> str:
    """The fault of `command` for an arm with `n_joints`, "" for a valid one.

    A driver sends no other command to the arm, and no other command may feed a watchdog: an invalid one shows that the
    sender runs, but not that it controls the arm.
    """
    if np.shape(command.u) != (n_joints,) or command.u.dtype.kind not in "fiu":
        return f"a command that does not have {n_joints} joint speeds"
    total = float(command.u.sum()) + command.opening + command.force
    return "" if total - total == 0.0 else "a command that is not finite"
