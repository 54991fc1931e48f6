"""The clock of the node: the system's, or `/clock` of a simulator; jumps are detected."""

from __future__ import annotations

MAX_JUMP = 0.1
"""Largest change [s] of the system's clock against the monotonic one between two readings."""
MAX_SIMULATED_STEP = 1.0
"""Largest step [s] between two messages on `/clock`."""
CLOCK_SILENCE = 0.5
"""Time [s] without a message on `/clock` after which the simulation counts as stopped."""


class RosClock:
    """The time of ROS, and a time for timeouts that no change of the system's clock disturbs.

    With `use_sim_time` both are the time of `/clock`, so that a slow simulation has the same timeouts.
    """

    def __init__(self, *, use_sim_time: bool) -> None:
        """Begin before the first reading."""
        self._simulated = use_sim_time
        self._ros = self._monotonic = None if use_sim_time else 0.0
        self._received = 0.0
        self._offset: float | None = None

    @property
    def started(self) -> bool:
        """Whether the time is known: with `use_sim_time` only after the first message on `/clock`."""
        return self._ros is not None

    @property
    def ros(self) -> float:
        """The time of ROS [s] at the last reading."""
        return self._ros or 0.0

    @property
    def elapsed(self) -> float:
        """The time for timeouts [s] at the last reading."""
        return self.ros if self._simulated else (self._monotonic or 0.0)

    def read(self, system: float, monotonic: float) -> str:
        """Read the clocks of the system [s]; returns why the time is unusable, or ""."""
        self._monotonic = monotonic
        if self._simulated:
            if self._ros is None:
                return "No message on /clock. Remedy: start the simulator, or set `use_sim_time` to false"
            silent = monotonic - self._received
            return (
                f"/clock is silent for {silent:.1f} s. Remedy: continue the simulation"
                if silent > CLOCK_SILENCE
                else ""
            )
        offset, previous = system - monotonic, self._offset
        self._ros, self._offset = system, offset
        if previous is not None and abs(offset - previous) > MAX_JUMP:
            return _jump(offset - previous, "let a time service adjust the clock gradually")
        return ""

    def receive(self, simulated: float, monotonic: float) -> str:
        """Take the time [s] of a message on `/clock`; returns why it is a jump, or ""."""
        previous = self._ros
        self._ros, self._received = simulated, monotonic
        if previous is None or 0.0 <= simulated - previous <= MAX_SIMULATED_STEP:
            return ""
        return _jump(simulated - previous, "publish /clock from one simulator, and let the arm rest during its reset")


def _jump(change: float, remedy: str) -> str:
    return f"The clock jumped by {change:+.2f} s. Remedy: {remedy}"
