"""The simulated robot as a process: physics at 1 kHz of real time, a watchdog of its own, perception at its own rate.

    python -m dualbrain.control.gatekeeper.robot_link.simulated_robot FD        (one line of settings on standard input)

When no command has come for `WATCHDOG` seconds, or the link is gone, the drive goes off and the brakes engage. Without
a link it goes on for `AFTERMATH` seconds, so that what happens then is judged too, and leaves its report.
"""

from __future__ import annotations

import socket
import sys
import time
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from dualbrain.control.gatekeeper.robot_link import packets
from dualbrain.control.gatekeeper.robot_link.packet_socket import MalformedPacket, PacketSocket
from dualbrain.records import Judgement
from dualbrain.robots.interface import Command
from dualbrain.robots.loader import load_robot
from dualbrain.robots.model import RobotModel
from dualbrain.simulation.scenes.scene_spec import SceneSpec
from dualbrain.simulation.tasks.multi_goal import parse_goals
from dualbrain.simulation.world import make_world

WATCHDOG_TIMEOUT = 0.1
"""No command for this long [s]: the drive goes off."""
AFTERMATH_TIME = 1.0
MAX_LAG = 0.1
"""When physics falls this far behind the clock [s], it goes on from there instead of racing after it."""
PERCEPTION_PERIOD = 0.033
"""Time between two pictures [s]."""


class SimulatedRobotSettings(msgspec.Struct, frozen=True, kw_only=True):
    """What the robot process needs to know; `report` is written at the end ("" for none).

    `body` is the robot as a site narrows it, where there is one.
    """

    robot: str
    scene: SceneSpec
    seed: int = 0
    goal: str = ""
    report: str = ""
    robot_model: RobotModel | None = None


class RobotReport(msgspec.Struct, frozen=True, kw_only=True):
    """What is left of a robot: times [s of CLOCK_MONOTONIC], how long and how far it still moved, what truth says.

    `silent_at`: the last command came; `off_at`: the drive went off; `travel` [rad] since then; `speed` [rad/s] at the
    end; `slips`: how often physics fell behind.
    """

    silent_at: float
    off_at: float | None
    off_by: str
    travel: float
    speed: float
    slips: int
    ticks: int
    judgement: Judgement


class RobotProcess:
    """Plant, perception, monitor and watchdog on one end of the wire."""

    def __init__(self, settings: SimulatedRobotSettings, link: socket.socket) -> None:
        """Build the world; nothing moves yet."""
        robot_model, spec = settings.robot_model or load_robot(settings.robot), settings.scene
        goal = parse_goals(settings.goal, spec) if settings.goal else None
        self.world = make_world(spec, robot_model, seed=settings.seed, goal=goal)
        self.plant = self.world.plant
        self._packet_socket: PacketSocket[packets.ToRobot] = PacketSocket(link, packets.decode_to_robot)
        self._settings, self._period, self._shutdown_requested = settings, robot_model.period, False
        self._scene_period_ticks = perception_period_ticks(robot_model.period)
        self._last_command_at, self._armed = time.monotonic(), False
        self._off_at: float | None = None
        self._off_by, self._off_q = "", self.plant.read().q
        self._slips = self._ticks = 0

    def serve(self) -> None:
        """Run until told to quit or, without a link, until the aftermath is over."""
        due = time.monotonic()
        while not self._shutdown_requested and (
            self._packet_socket.is_open or time.monotonic() - self._last_command_at < AFTERMATH_TIME
        ):
            self._receive()
            self._check_watchdog(time.monotonic())
            self._tick()
            due += self._period
            ahead = due - time.monotonic()
            if ahead > 0.0:
                self._wait(ahead, due)
            elif ahead < -MAX_LAG:
                due, self._slips = time.monotonic(), self._slips + 1
        self._write_report()

    def _tick(self) -> None:
        self.world.advance()
        state = self.plant.read()
        self._packet_socket.send(packets.StatePacket.from_state(state))
        if self._ticks % self._scene_period_ticks == 0:
            self._packet_socket.send(packets.ScenePacket(self.world.perceive()))
        self._ticks += 1

    def _wait(self, ahead: float, due: float) -> None:
        """Until the next tick; a command that comes meanwhile is taken at once."""
        while ahead > 0.0:
            if self._packet_socket.wait(ahead):
                self._receive()
            ahead = due - time.monotonic()

    def _check_watchdog(self, now: float) -> None:
        """The robot's own watchdog: armed by the first command, it knows nothing of orders, only of silence."""
        silent = self._armed and now - self._last_command_at > WATCHDOG_TIMEOUT
        if self._off_at is None and (silent or not self._packet_socket.is_open):
            self._stop_drive("watchdog")

    def _stop_drive(self, by: str) -> None:
        self.plant.stop()
        if self._off_at is None:
            self._off_at, self._off_by, self._off_q = time.monotonic(), by, self.plant.read().q

    def _receive(self) -> None:
        while (packet := self._packet_socket.receive()) is not None:
            self._apply_packet(packet)

    def _apply_packet(self, packet: packets.ToRobot | MalformedPacket) -> None:
        match packet:
            case MalformedPacket():
                self._stop_drive("rubbish")
            case packets.CommandPacket(u, opening, force):
                self._last_command_at, self._armed = time.monotonic(), True
                if len(u) == self.plant.robot_model.n and np.isfinite([*u, opening, force]).all():
                    self.plant.write(Command(np.array(u), opening, force))
            case packets.DrivePacket(on=False):
                self._last_command_at = time.monotonic()
                self._stop_drive("order")
            case packets.DrivePacket():
                self._last_command_at, self._off_at = time.monotonic(), None
                self.plant.enable()
            case packets.PhasePacket(phase, roles):
                self.world.set_phase(phase, roles)
            case packets.ContractPacket(contract):
                self.world.start_contract(contract)
            case packets.ShutdownPacket():
                self._shutdown_requested = True

    def _write_report(self) -> None:
        if not self._settings.report:
            return
        state = self.plant.read()
        report = RobotReport(
            silent_at=self._last_command_at,
            off_at=self._off_at,
            off_by=self._off_by,
            travel=float(np.abs(state.q - self._off_q).max()),
            speed=float(np.abs(state.v).max()),
            slips=self._slips,
            ticks=self._ticks,
            judgement=self.world.judgement(),
        )
        Path(self._settings.report).write_bytes(msgspec.json.encode(report))


def perception_period_ticks(period: float) -> int:
    """Ticks from one picture to the next, for a robot whose states come every `period` [s]."""
    return max(1, round(PERCEPTION_PERIOD / period))


def main(arguments: list[str]) -> None:
    """Serve on the inherited socket."""
    link = socket.socket(fileno=int(arguments[0]))
    settings: Any = msgspec.json.decode(sys.stdin.buffer.readline(), type=SimulatedRobotSettings)
    RobotProcess(settings, link).serve()


if __name__ == "__main__":
    main(sys.argv[1:])
