"""The driver contract: a `Robot` with a beat of its own, that tells what its maker says is wrong."""

from __future__ import annotations

from typing import Protocol

from dualbrain.robots.interface import Command, RobotInterface
from dualbrain.safety.supervisor.timing import Timing


class Driver(RobotInterface, Protocol):
    """What a driver adds to `Robot`. The laws that it keeps are in `conformance.py`.

    It never raises once it is open: what the maker's library raises is told by `faults()`, and shows as
    `read().drive_enabled` False.
    """

    @property
    def timing(self) -> Timing:
        """How punctual its bus is."""
        ...

    @property
    def watchdog(self) -> float:
        """After so long [s] without a command the arm stops by itself; infinite where nobody watches."""
        ...

    def wait(self) -> None:
        """Until the next joint state, which `read` then gives."""
        ...

    def faults(self) -> tuple[str, ...]:
        """Why the drive is off unasked, in the maker's words; empty while nothing is wrong."""
        ...

    def close(self) -> None:
        """Stop, and let go of the arm; safe to call again."""
        ...


def is_finite(command: Command) -> bool:
    """Whether every number of `command` is finite: what is not never reaches an arm."""
    total = float(command.u.sum()) + command.opening + command.force
    return total - total == 0.0
