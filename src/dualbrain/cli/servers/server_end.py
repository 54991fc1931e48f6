"""The end of a server with its robot: it begins at a signal or a closed input, and has a deadline."""

from __future__ import annotations

from threading import Event
from typing import TYPE_CHECKING

from dualbrain.cli.common.exit_codes import ExitCode
from dualbrain.core.processes.process_end import EndDeadline

if TYPE_CHECKING:
    from dualbrain.agent_api.robot import Robot

END_LIMIT = 1.7
"""Longest time [s] from a signal or a closed input to the end of server, gatekeeper and simulated robot."""


class ServerEnd:
    """Ends the server of `robot`: the robot brakes to rest at once, while the connections of clients end."""

    def __init__(self, robot: Robot) -> None:
        """Kill a gatekeeper that was started for `robot`, and end the server, `END_LIMIT` after `begin`."""
        self._robot, self._begun = robot, Event()
        self._deadline = EndDeadline(END_LIMIT, robot.kill, code=ExitCode.SETUP)

    @property
    def has_begun(self) -> bool:
        """Whether the server is ending."""
        return self._begun.is_set()

    def begin(self) -> None:
        """Start the deadline and brake the robot, without waiting; later calls change nothing."""
        self._deadline.start()
        self._begun.set()
        self._robot.begin_close()
