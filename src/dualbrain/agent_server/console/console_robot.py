"""The part of a robot that the console uses; it has no further rights."""

from __future__ import annotations

from typing import Any, Protocol

from dualbrain.contracts.verdict import Verdict
from dualbrain.control.gatekeeper.protocol.messages import StatusReport


class ConsoleRobot(Protocol):
    """Perception, checks without effects, and stops: nothing that submits a contract, resets, resumes or speeds up."""

    @property
    def name(self) -> str:
        """Name of the robot."""
        ...

    def scene(self) -> dict[str, Any]:
        """The perceived scene; see `Robot.scene`."""
        ...

    def schema(self) -> dict[str, Any]:
        """The schema of a contract in the present scene; see `Robot.schema`."""
        ...

    def check(self, contract: bytes) -> Verdict:
        """The gate's verdict on a contract, without effects; see `Robot.check`."""
        ...

    def events(self, after: int = 0) -> list[dict[str, Any]]:
        """The events after the one with the number `after`; see `Robot.events`."""
        ...

    def status(self) -> StatusReport | None:
        """The gatekeeper's newest status; see `Robot.status`."""
        ...

    def stop(self, *, emergency: bool = False) -> StatusReport | None:
        """Stop the robot; see `Robot.stop`."""
        ...
