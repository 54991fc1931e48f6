"""The gatekeeper's end of the robot link: the arrival of joint states paces the control tick."""

from __future__ import annotations

import socket
import subprocess
import time
from math import inf, isfinite
from typing import Any

import msgspec
from numpy.typing import NDArray

from dualbrain.contracts.contract import Contract
from dualbrain.control.gatekeeper.robot_link import packets
from dualbrain.control.gatekeeper.robot_link.driver_process import DriverSettings
from dualbrain.control.gatekeeper.robot_link.packet_socket import MalformedPacket, PacketSocket, socket_pair
from dualbrain.control.gatekeeper.robot_link.simulated_robot import SimulatedRobotSettings
from dualbrain.control.gatekeeper.timing.tick_profile import TickProfiler
from dualbrain.control.gatekeeper.timing.tick_timing import TickTimer
from dualbrain.core.processes.parent_pipe import start_child
from dualbrain.errors import ConfigurationError
from dualbrain.records import Scene
from dualbrain.robots.interface import Command, RobotState
from dualbrain.safety.supervisor.timing import Timing

STATE_TIMEOUT_PERIODS = 5
"""Periods that a tick waits for a state; it then continues with the old one, whose age the state monitor checks."""
STARTUP_TIMEOUT = 60.0
"""Longest time [s] until the first state and scene of the robot process."""
NO_STAMP = (-inf, 0.0)
"""Newest stamp and its arrival before the first finite stamp."""
NOT_STARTED = "The robot process has not started."


class RemoteRobot:
    """A robot in another process; implements `RobotLink`."""

    def __init__(
        self,
        settings: SimulatedRobotSettings | DriverSettings,
        timing: Timing,
        profiler: TickProfiler | None = None,
        *,
        control_end: socket.socket | None = None,
    ) -> None:
        """Start the process of the simulated robot or of a driver, and wait for its first state and scene.

        `control_end` is the robot's end of the link to a control thread, which is closed here.

        Raises `ConfigurationError` if the process ends or none arrives in time.
        """
        here, there = socket_pair()
        ends = [there] if control_end is None else [there, control_end]
        data, descriptors = msgspec.json.encode(settings), tuple(end.fileno() for end in ends)
        self.process = start_child(_process_module(settings), data, *map(str, descriptors), pass_fds=descriptors)
        for end in ends:
            end.close()
        self._packet_socket: PacketSocket[packets.FromRobot] = PacketSocket(here, packets.decode_from_robot)
        self._timing = timing
        self.tick_timer, self._profiler = TickTimer(timing), profiler or TickProfiler()
        self._state: RobotState | None = None
        self._scene: Scene | None = None
        self._newest_stamp, self._arrived_at = NO_STAMP
        self._wait_for_start()

    # --- robot --------------------------------------------------------------------------------------------------

    def read(self) -> RobotState:
        """The newest received joint state."""
        if self._state is None:
            raise ConfigurationError.stating(NOT_STARTED)
        return self._state

    def write(self, command: Command) -> None:
        """Send a command."""
        self._packet_socket.send(packets.CommandPacket(tuple(command.u.tolist()), command.opening, command.force))
        self.tick_timer.on_command(time.monotonic())

    def stop(self) -> None:
        """Drive off."""
        self._packet_socket.send(packets.DrivePacket(on=False))

    def enable(self) -> None:
        """Drive on."""
        self._packet_socket.send(packets.DrivePacket(on=True))

    # --- environment --------------------------------------------------------------------------------------------

    def perceive(self) -> Scene:
        """The newest received scene."""
        if self._scene is None:
            raise ConfigurationError.stating(NOT_STARTED)
        return self._scene

    def advance(self) -> None:
        """Wait for the next joint state, at most `STATE_TIMEOUT_PERIODS` periods, because a dead robot sends none.

        If a period is long, wait at most until the newest state counts as stale.
        """
        self.tick_timer.on_tick_end(time.monotonic())
        self._profiler.end_tick()
        if not self._packet_socket.is_open:
            time.sleep(self._timing.period)
        before = self._state
        deadline = time.monotonic() + min(STATE_TIMEOUT_PERIODS * self._timing.period, self._timing.state_stale_after)
        while self._packet_socket.is_open and self._state is before and (left := deadline - time.monotonic()) > 0.0:
            arrived = self._packet_socket.wait(left)
            self._profiler.mark_part("wait")
            if arrived:
                self._receive()
                self._profiler.mark_part("read")

    def skip_to_newest_state(self) -> None:
        """Take the newest state, and begin to measure ticks."""
        self._receive()
        self.tick_timer = TickTimer(self._timing)

    def clock(self) -> float:
        """The newest stamp plus the time since its arrival [s]; no state stops it, sets it back or makes it infinite.

        Before the first finite stamp it is the monotonic time.
        """
        stamp = self._newest_stamp if self._newest_stamp > -inf else 0.0
        return stamp + (time.monotonic() - self._arrived_at)

    def conditions(self) -> int:
        """Timing `Condition` bits since the last call."""
        return self.tick_timer.conditions()

    def notes(self) -> list[str]:
        """No texts: everything that happens on this link is a condition."""
        return []

    def thread_ticks(self) -> NDArray[Any] | None:
        """None: no thread moves the joints."""
        return None

    def timing_faults(self) -> tuple[int, int]:
        """Number of ticks so far that took too long, and of joint states that never arrived."""
        return self.tick_timer.late, self.tick_timer.missed

    # --- for the simulated robot ---------------------------------------------------------------------------------

    def set_phase(self, phase: str, roles: dict[str, str | None]) -> None:
        """Report the phase to the monitor of a simulation."""
        self._packet_socket.send(packets.PhasePacket(phase, roles))

    def start_contract(self, contract: Contract) -> None:
        """Report the contract to the judge of a simulation."""
        self._packet_socket.send(packets.ContractPacket(contract))

    def close(self) -> None:
        """Switch the drive off and end the robot process; kill it if it does not end."""
        self.stop()
        self._packet_socket.send(packets.ShutdownPacket())
        try:
            self.process.wait(timeout=5.0)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
        self._packet_socket.close()  # not earlier: unread states would make the robot lose the shutdown packet
        if self.process.stdin:
            self.process.stdin.close()

    # --- inside -------------------------------------------------------------------------------------------------

    def _wait_for_start(self) -> None:
        deadline = time.monotonic() + STARTUP_TIMEOUT
        while (self._state is None or self._scene is None) and time.monotonic() < deadline:
            if self.process.poll() is not None:
                raise ConfigurationError.stating(
                    f"The robot process exited with code {self.process.returncode} before its first state.",
                    fix="See its messages on standard error.",
                )
            if self._packet_socket.wait(0.1):
                self._receive()
        if self._state is None or self._scene is None:
            raise ConfigurationError.stating(
                f"The robot process sent no state and scene within {STARTUP_TIMEOUT:.0f} s."
            )

    def _receive(self) -> None:
        """Process all received packets."""
        while (packet := self._packet_socket.receive()) is not None:
            match packet:
                case packets.StatePacket():
                    self._accept_state(packet)
                case packets.ScenePacket(scene):
                    self._scene = scene
                case MalformedPacket(reason):
                    raise ConfigurationError.stating(f"The robot process sent a malformed packet: {reason}.")

    def _accept_state(self, state: packets.StatePacket) -> None:
        now = time.monotonic()
        if isfinite(state.stamp) and state.stamp > self._newest_stamp:
            self._newest_stamp, self._arrived_at = state.stamp, now
        lost = state.sequence - self._state.sequence - 1 if self._state else 0
        self._state = state.to_robot_state()
        self.tick_timer.on_state(now, lost)


def _process_module(settings: SimulatedRobotSettings | DriverSettings) -> str:
    process = "driver_process" if isinstance(settings, DriverSettings) else "simulated_robot"
    return f"dualbrain.control.gatekeeper.robot_link.{process}"
