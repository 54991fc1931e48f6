"""What a gatekeeper asks of the robot at the other end of its wire, be it a process or a simulation in lockstep."""

from __future__ import annotations

from typing import Protocol

from dualbrain.contracts.contract import Contract
from dualbrain.control.control_loop import WorldInterface
from dualbrain.robots.interface import RobotInterface


class RobotLink(RobotInterface, WorldInterface, Protocol):
    """A robot and its surroundings, with a clock and conditions of timing of their own."""

    def clock(self) -> float:
        """The robot's time as far as it can be known here [s]."""
        ...

    def conditions(self) -> int:
        """`Condition` bits of timing since the last call."""
        ...

    def set_phase(self, phase: str, roles: dict[str, str | None]) -> None:
        """A phase begins: whoever judges a simulation knows what may be touched in it."""
        ...

    def start_contract(self, contract: Contract) -> None:
        """A contract was accepted."""
        ...
