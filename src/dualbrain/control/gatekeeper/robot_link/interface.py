"""What a gatekeeper asks of the robot at the other end of its wire, be it a process or a simulation in lockstep."""

from __future__ import annotations

from typing import Protocol

from dualbrain.contracts.contract import Contract
from dualbrain.control.control_loop import Surroundings
from dualbrain.robots.interface import Robot


class Wired(Robot, Surroundings, Protocol):
    """A robot and its surroundings, with a clock and conditions of timing of their own."""

    def clock(self) -> float:
        """The robot's time as far as it can be known here [s]."""
        ...

    def flags(self) -> int:
        """`Condition` bits of timing since the last call."""
        ...

    def allow(self, phase: str, roles: dict[str, str | None]) -> None:
        """A phase begins: whoever judges a simulation knows what may be touched in it."""
        ...

    def begin(self, contract: Contract) -> None:
        """A contract was accepted."""
        ...
