"""The gatekeeper's end of the wire: a robot and its surroundings, whose joint states beat the control tick's time."""

from __future__ import annotations

import select
import socket
import subprocess
import sys
import time
from contextlib import suppress

import msgspec
import numpy as np

from dualbrain.contracts.contract import Contract
from dualbrain.embodiment.robot import Command, RobotState
from dualbrain.errors import InvalidSetup
from dualbrain.records import Judgement, Scene
from dualbrain.runtime.gatekeeper import bus
from dualbrain.runtime.gatekeeper.driver_process import DriverSettings
from dualbrain.runtime.gatekeeper.metronome import Metronome
from dualbrain.runtime.gatekeeper.robot_process import Settings
from dualbrain.safety.timing import Timing

PATIENCE = 5
"""Periods that a tick waits for a state; then it goes on with the old one, and the watch sees that."""
START = 60.0
"""How long the robot may take to come up [s]."""
BUFFER = 1 << 20


class RemoteRobot:
    """`Robot` and `Surroundings` in one; `clock()` is the robot's time as far as it can be known here [s]."""

    def __init__(self, settings: Settings | DriverSettings, timing: Timing) -> None:
        """Start the process of the simulated robot, or of a driver, and wait for its first state and scene.

        Raises `InvalidSetup` if none comes.
        """
        here, there = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        for end in (here, there):
            end.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, BUFFER)
        self.process = subprocess.Popen(
            [sys.executable, *_flags(), "-m", _module(settings), str(there.fileno())],
            stdin=subprocess.PIPE, pass_fds=(there.fileno(),),
        )  # fmt: skip
        there.close()
        if self.process.stdin:
            self.process.stdin.write(msgspec.json.encode(settings) + b"\n")
            self.process.stdin.flush()
        here.setblocking(False)
        self._link, self._timing = here, timing
        self.metronome = Metronome(timing)
        self._state: RobotState | None = None
        self._scene: Scene | None = None
        self._judgement: Judgement | None = None
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
        self._send(bus.Write(tuple(command.u.tolist()), command.opening, command.force))
        self.metronome.sent(time.monotonic())

    def stop(self) -> None:
        """Drive off."""
        self._send(bus.Switch(on=False))

    def enable(self) -> None:
        """Drive on."""
        self._send(bus.Switch(on=True))

    # --- surroundings -------------------------------------------------------------------------------------------

    def look(self) -> Scene:
        """The newest scene that has come."""
        if self._scene is None:
            raise InvalidSetup("a robot without a scene", got=None, allowed="a robot process that has started")
        return self._scene

    def advance(self) -> None:
        """Until the next joint state, at most `PATIENCE` periods."""
        self.metronome.ended(time.monotonic())
        before = self._state
        deadline = time.monotonic() + PATIENCE * self._timing.period
        while self._state is before and (left := deadline - time.monotonic()) > 0.0:
            if select.select((self._link,), (), (), left)[0] and not self._receive():
                return

    def clock(self) -> float:
        """The newest state's stamp, and the time since it came [s]."""
        return self.read().stamp + (time.monotonic() - self._received)

    def flags(self) -> int:
        """`Condition` bits of timing since the last call."""
        return self.metronome.flags()

    # --- the simulated robot's own ------------------------------------------------------------------------------

    def allow(self, phase: str, roles: dict[str, str | None]) -> None:
        """Tell the monitor what may be touched."""
        self._send(bus.Allow(phase, roles))

    def begin(self, contract: Contract) -> None:
        """Tell the referee what is to be done."""
        self._send(bus.Begin(contract))

    def judge(self) -> Judgement | None:
        """What truth says; the answer comes while the robot goes on."""
        self._judgement = None
        self._send(bus.Judge())
        deadline = time.monotonic() + 2.0
        while self._judgement is None and time.monotonic() < deadline:
            if select.select((self._link,), (), (), 0.1)[0] and not self._receive():
                break
        return self._judgement

    def close(self) -> None:
        """Drive off, and the robot is switched off."""
        self.stop()
        self._send(bus.Quit())
        self._link.close()
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
            if select.select((self._link,), (), (), 0.1)[0]:
                self._receive()
        if self._state is None or self._scene is None:
            raise InvalidSetup("robot process", got="silence", allowed=f"a first state within {START:.0f} s")

    def _receive(self) -> bool:
        """Take in everything that has come; False when the link is gone."""
        while True:
            try:
                data = self._link.recv(bus.PACKET)
            except BlockingIOError:
                return True
            except OSError:
                data = b""
            if not data:
                time.sleep(self._timing.period)  # a dead robot beats no time
                return False
            packet: bus.FromRobot = bus.from_robot(data)
            match packet:
                case bus.State():
                    self._take(packet)
                case bus.Seen(scene):
                    self._scene = scene
                case bus.Judged(judgement):
                    self._judgement = judgement

    def _take(self, state: bus.State) -> None:
        self._received = time.monotonic()
        lost = state.sequence - self._state.sequence - 1 if self._state else 0
        self._state = RobotState(
            state.stamp, state.sequence, np.array(state.q), np.array(state.v), state.opening, state.forces, state.driven
        )  # fmt: skip
        self.metronome.arrived(self._received, lost)

    def _send(self, packet: bus.ToRobot) -> None:
        """A packet that does not go at once is lost; the robot's watchdog counts them."""
        with suppress(OSError):
            self._link.send(bus.encode(packet))


def _module(settings: Settings | DriverSettings) -> str:
    process = "driver_process" if isinstance(settings, DriverSettings) else "robot_process"
    return f"dualbrain.runtime.gatekeeper.{process}"


def _flags() -> list[str]:
    """How this interpreter was started, as far as it matters for finding packages."""
    return ["-S"] if sys.flags.no_site else []
