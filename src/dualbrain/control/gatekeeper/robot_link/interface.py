"""The interface between a gatekeeper and its robot: a separate process, or a simulation in lockstep."""

from __future__ import annotations

from typing import Any, Protocol

from numpy.typing import NDArray

from dualbrain.contracts.contract import Contract
from dualbrain.control.control_loop import WorldInterface
from dualbrain.robots.interface import RobotInterface


class RobotLink(RobotInterface, WorldInterface, Protocol):
    """A robot and its environment, with a clock and timing conditions."""

    def skip_to_newest_state(self) -> None:
        """Take the newest state before the first tick; older ones arrived while the gatekeeper was being prepared."""
        ...

    def clock(self) -> float:
        """Estimate of the robot's time [s]."""
        ...

    def conditions(self) -> int:
        """Timing `Condition` bits since the last call."""
        ...

    def notes(self) -> list[str]:
        """Texts about the link since the last call, for the recording."""
        ...

    def thread_ticks(self) -> NDArray[Any] | None:
        """Records of the ticks of a control thread since the last call, for the recording; None without any."""
        ...

    def timing_faults(self) -> tuple[int, int]:
        """Number of ticks so far that took too long, and of joint states that never arrived."""
        ...

    def set_phase(self, phase: str, roles: dict[str, str | None]) -> None:
        """Report a new phase and its objects by role; a simulation's monitor derives the permitted contacts from it."""
        ...

    def start_contract(self, contract: Contract) -> None:
        """Report an accepted contract; a simulation's judge derives its goals from it."""
        ...
