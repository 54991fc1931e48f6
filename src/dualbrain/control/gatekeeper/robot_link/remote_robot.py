"""The gatekeeper's end of the wire: a robot and its surroundings, whose joint states beat the control tick's time."""

from __future__ import annotations

import subprocess
import sys
import time

import msgspec
import numpy as np

from dualbrain.contracts.contract import Contract
from dualbrain.control.gatekeeper.robot_link import packets
from dualbrain.control.gatekeeper.robot_link.driver_process import DriverSettings
from dualbrain.control.gatekeeper.robot_link.packet_socket import Rubbish, Wire, pair
from dualbrain.control.gatekeeper.robot_link.simulated_robot import Settings
from dualbrain.control.gatekeeper.timing.tick_profile import Laps
from dualbrain.control.gatekeeper.timing.tick_timing import Metronome
from dualbrain.errors import InvalidSetup
from dualbrain.records import Scene
from dualbrain.robots.interface import Command, RobotState
from dualbrain.safety.supervisor.timing import Timing

PATIENCE = 5
"""Periods that a tick waits for a state; then it goes on with the old one, and the watch sees that."""
START = 60.0
"""How long the robot may take to come up [s]."""


class RemoteRobot:
    """`Robot` and `Surroundings` in one; `clock()` is the robot's time as far as it can be known here [s]."""

    def __init__(self, settings: Settings | DriverSettings, timing: Timing, laps: Laps | None = None) -> None:
        """Start the process of the simulated robot, or of a driver, and wait for its first state and scene.

        Raises `InvalidSetup` if none comes.
        """
        here, there = pair()
        self.process = subprocess.Popen(
            [sys.executable, *_flags(), "-m", _module(settings), str(there.fileno())],
            stdin=subprocess.PIPE, pass_fds=(there.fileno(),),
        )  # fmt: skip
        there.close()
        if self.process.stdin:
            self.process.stdin.write(msgspec.json.encode(settings) + b"\n")
            self.process.stdin.flush()
        self._wire: Wire[packets.FromRobot] = Wire(here, packets.from_robot)
        self._timing = timing
        self.metronome, self._laps = Metronome(timing), laps or Laps()
        self._state: RobotState | None = None
        self._scene: Scene | None = None
        self._received = 0.0
        self._wait_for_start()

    # --- robot --------------------------------------------------------------------------------------------------

    def read(self) -> RobotState:
        """The newest joint state that has come."""
        if self._state is None:
            raise InvalidSetup("a robot without a state", got=None, allowed="a robot process that has started")
        return self._state

    def write(self, command: Command) -> None:
        """Send a command."""
        self._wire.send(packets.Write(tuple(command.u.tolist()), command.opening, command.force))
        self.metronome.sent(time.monotonic())

    def stop(self) -> None:
        """Drive off."""
        self._wire.send(packets.Switch(on=False))

    def enable(self) -> None:
        """Drive on."""
        self._wire.send(packets.Switch(on=True))

    # --- surroundings -------------------------------------------------------------------------------------------

    def look(self) -> Scene:
        """The newest scene that has come."""
        if self._scene is None:
            raise InvalidSetup("a robot without a scene", got=None, allowed="a robot process that has started")
        return self._scene

    def advance(self) -> None:
        """Until the next joint state, at most `PATIENCE` periods, as a dead robot beats no time.

        Where a period is long, no longer than a state may be old.
        """
        self.metronome.ended(time.monotonic())
        self._laps.ended()
        if not self._wire.open:
            time.sleep(self._timing.period)
        before = self._state
        deadline = time.monotonic() + min(PATIENCE * self._timing.period, self._timing.stale)
        while self._wire.open and self._state is before and (left := deadline - time.monotonic()) > 0.0:
            heard = self._wire.wait(left)
            self._laps.lap("wait")
            if heard:
                self._receive()
                self._laps.lap("read")

    def clock(self) -> float:
        """The newest state's stamp, and the time since it came [s]."""
        return self.read().stamp + (time.monotonic() - self._received)

    def flags(self) -> int:
        """`Condition` bits of timing since the last call."""
        return self.metronome.flags()

    # --- the simulated robot's own ------------------------------------------------------------------------------

    def allow(self, phase: str, roles: dict[str, str | None]) -> None:
        """Tell the monitor what may be touched."""
        self._wire.send(packets.Allow(phase, roles))

    def begin(self, contract: Contract) -> None:
        """Tell the referee what is to be done."""
        self._wire.send(packets.Begin(contract))

    def close(self) -> None:
        """Drive off, and the robot is switched off."""
        self.stop()
        self._wire.send(packets.Quit())
        self._wire.close()
        try:
            self.process.wait(timeout=5.0)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
        if self.process.stdin:
            self.process.stdin.close()

    # --- inside -------------------------------------------------------------------------------------------------

    def _wait_for_start(self) -> None:
        deadline = time.monotonic() + START
        while (self._state is None or self._scene is None) and time.monotonic() < deadline:
            if self.process.poll() is not None:
                raise InvalidSetup("robot process", got=f"exit code {self.process.returncode}", allowed="one that runs")
            if self._wire.wait(0.1):
                self._receive()
        if self._state is None or self._scene is None:
            raise InvalidSetup("robot process", got="silence", allowed=f"a first state within {START:.0f} s")

    def _receive(self) -> None:
        """Take in everything that has come."""
        while (packet := self._wire.hear()) is not None:
            match packet:
                case packets.State():
                    self._take(packet)
                case packets.Seen(scene):
                    self._scene = scene
                case Rubbish(reason):
                    raise InvalidSetup("packet of the robot", got=reason, allowed="a state or a scene")

    def _take(self, state: packets.State) -> None:
        self._received = time.monotonic()
        lost = state.sequence - self._state.sequence - 1 if self._state else 0
        self._state = RobotState(
            state.stamp, state.sequence, np.array(state.q), np.array(state.v), state.opening, state.forces, state.driven
        )  # fmt: skip
        self.metronome.arrived(self._received, lost)


def _module(settings: Settings | DriverSettings) -> str:
    process = "driver_process" if isinstance(settings, DriverSettings) else "simulated_robot"
    return f"dualbrain.control.gatekeeper.robot_link.{process}"


def _flags() -> list[str]:
    """How this interpreter was started, as far as it matters for finding packages."""
    return ["-S"] if sys.flags.no_site else []
