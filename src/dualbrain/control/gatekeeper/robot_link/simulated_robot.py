"""The process of the simulated robot: physics in real time, with its own watchdog and perception rate.

If no valid command arrives for `WATCHDOG_TIMEOUT` seconds, the link is closed or the gatekeeper has ended, the drive
is switched off and the brakes engage. Without a link, the simulation continues for `AFTERMATH_TIME` seconds, which the
judgement then includes, and writes its report; if no report is requested, it ends at once.
"""

from __future__ import annotations

import socket
import time
from pathlib import Path

import msgspec
import numpy as np

from dualbrain.control.gatekeeper.robot_link import packets
from dualbrain.control.gatekeeper.robot_link.control_link import ControlLink, inherited_links
from dualbrain.control.gatekeeper.robot_link.packet_socket import MalformedPacket, PacketSocket
from dualbrain.core.processes.parent_pipe import ParentPipe
from dualbrain.core.processes.realtime_priority import release_realtime_priority
from dualbrain.core.storage.atomic_files import write_atomically
from dualbrain.drivers.driver import command_fault
from dualbrain.grounding.outcome.instruction_truth import make_instruction_judge
from dualbrain.records import Judgement
from dualbrain.robots.interface import Command
from dualbrain.robots.loader import load_robot
from dualbrain.robots.model import RobotModel
from dualbrain.simulation.plant.end_state import EndState, read_end_state
from dualbrain.simulation.plant.plant_state import PlantState
from dualbrain.simulation.scenes.scene_spec import SceneSpec
from dualbrain.simulation.tasks.multi_goal import parse_goals
from dualbrain.simulation.world import make_world

WATCHDOG_TIMEOUT = 0.1
"""Time [s] without a valid command after which the drive is switched off."""
AFTERMATH_TIME = 1.0
"""Simulated time [s] after the link is closed."""
MAX_LAG_PERIODS = 2.0
"""Delay of the simulation [periods] beyond which it is resynchronized with the clock instead of catching up.

A host that stops this process stops simulated time. The robot moves on during a delay of the gatekeeper, as a real one.
"""
PERCEPTION_PERIOD = 0.033
"""Time between two perceived scenes [s]."""


class SimulatedRobotSettings(msgspec.Struct, frozen=True, kw_only=True):
    """Settings of the robot process; `report` is a file that it writes at its end ("" for none).

    `robot_model` is the robot with the limits of a site file, None without one. `start` is the state of the robot at
    the beginning, None for its home.
    """

    robot: str
    scene: SceneSpec
    seed: int = 0
    goal: str = ""
    instruction: str = ""
    report: str = ""
    robot_model: RobotModel | None = None
    start: PlantState | None = None


class RobotReport(
    msgspec.Struct,
    frozen=True,
    kw_only=True,
    rename={
        "last_command_at": "silent_at",
        "drive_off_at": "off_at",
        "drive_off_cause": "off_by",
        "resynchronizations": "slips",
    },
):
    """Final report of the robot process; times in [s] of CLOCK_MONOTONIC.

    `last_command_at`: arrival of the last valid command. `drive_off_at`, `drive_off_cause`: time at which the drive was
    switched off, and its cause. `travel` [rad]: largest joint motion since then. `speed` [rad/s]: largest joint speed
    at the end. `silent_periods`: control periods after the first command in which no valid one arrived;
    `longest_silence` [s]: longest time between two valid commands. `resynchronizations`: number of resynchronizations
    with the clock. `judgement`: result on ground truth. `end`: state from which another run can continue.
    """

    last_command_at: float
    drive_off_at: float | None
    drive_off_cause: str
    travel: float
    speed: float
    resynchronizations: int
    ticks: int
    judgement: Judgement
    silent_periods: int = 0
    longest_silence: float = 0.0
    end: EndState | None = None


class RobotProcess:
    """Plant, perception, monitor and watchdog at one end of the robot link."""

    def __init__(
        self, settings: SimulatedRobotSettings, link: socket.socket, control_link: ControlLink | None = None
    ) -> None:
        """Build the world; the robot is at rest. With a `control_link` a control thread moves the joints."""
        robot_model, spec = settings.robot_model or load_robot(settings.robot), settings.scene
        goal = parse_goals(settings.goal, spec) if settings.goal else None
        judge = make_instruction_judge(settings.instruction)
        self.world = make_world(
            spec, robot_model, seed=settings.seed, goal=goal, instruction_judge=judge, start=settings.start
        )
        self.plant = self.world.plant
        self._packet_socket: PacketSocket[packets.ToRobot] = PacketSocket(link, packets.decode_to_robot)
        self._control_link = control_link
        self._settings, self._period, self._shutdown_requested = settings, robot_model.period, False
        self._scene_period_ticks = perception_period_ticks(robot_model.period)
        self._last_command_at, self._armed = time.monotonic(), False
        self._off_at: float | None = None
        self._priority_released = False
        self._off_cause, self._off_q = "", self.plant.read().q
        self._resynchronizations = self._ticks = self._silent_periods = 0
        self._longest_silence, self._command_arrived = 0.0, False

    def lose_gatekeeper(self) -> None:
        """Continue as without a link, from any thread: the gatekeeper has ended."""
        self._packet_socket.mark_closed()

    def serve(self) -> None:
        """Run until shutdown or, without a link, until `AFTERMATH_TIME` is over."""
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
            elif ahead < -MAX_LAG_PERIODS * self._period:
                due, self._resynchronizations = time.monotonic(), self._resynchronizations + 1
        self._write_report()

    def _tick(self) -> None:
        self._silent_periods += self._armed and not self._command_arrived and self._packet_socket.is_open
        self._command_arrived = False
        self.world.advance()
        state = self.plant.read()
        if self._control_link is not None:
            self._control_link.send_state(state)
        self._packet_socket.send(packets.StatePacket.from_state(state))
        if self._ticks % self._scene_period_ticks == 0:
            self._packet_socket.send(packets.ScenePacket(self.world.perceive()))
        self._ticks += 1

    def _wait(self, ahead: float, due: float) -> None:
        """Wait for the next tick; a command that arrives meanwhile is applied at once."""
        while ahead > 0.0:
            if self._packet_socket.wait(ahead):
                self._receive()
            ahead = due - time.monotonic()

    def _check_watchdog(self, now: float) -> None:
        """The robot's own watchdog, armed by the first command: it reacts only to the absence of valid commands."""
        silent = self._armed and now - self._last_command_at > WATCHDOG_TIMEOUT
        if self._off_at is None and (silent or not self._packet_socket.is_open):
            self._stop_drive("watchdog")
        if not self._packet_socket.is_open and not self._priority_released:
            self._priority_released = True
            release_realtime_priority()

    def _stop_drive(self, cause: str) -> None:
        self.plant.stop()
        if self._off_at is None:
            self._off_at, self._off_cause, self._off_q = time.monotonic(), cause, self.plant.read().q

    def _receive(self) -> None:
        while (packet := self._packet_socket.receive()) is not None:
            self._apply_packet(packet)
        if self._control_link is not None:
            self._receive_thread_commands(self._control_link)

    def _receive_thread_commands(self, control_link: ControlLink) -> None:
        received = control_link.receive()
        if isinstance(received, MalformedPacket):
            self._stop_drive("rubbish")
        elif received is not None:
            if received.switched is not None:
                self._switch_drive(on=received.switched)
            if (command := control_link.complete(received.command)) is not None:
                self._apply_command(command)

    def _apply_packet(self, packet: packets.ToRobot | MalformedPacket) -> None:
        match packet:
            case MalformedPacket():
                self._stop_drive("rubbish")
            case packets.CommandPacket(u, opening, force):
                command = Command(np.array(u, dtype=float), opening, force)
                if self._control_link is not None:
                    self._control_link.set_gripper(command)
                else:
                    self._apply_command(command)
            case packets.DrivePacket(on):
                self._switch_drive(on=on)
            case packets.PhasePacket(phase, roles):
                self.world.set_phase(phase, roles)
            case packets.ContractPacket(contract):
                self.world.start_contract(contract)
            case packets.ShutdownPacket():
                self._shutdown_requested = True

    def _switch_drive(self, *, on: bool) -> None:
        if not on:
            self._last_command_at = time.monotonic()
            self._stop_drive("order")
            return
        if self._off_at is not None:  # a repeated order is no command and does not feed the watchdog
            self._last_command_at, self._off_at = time.monotonic(), None
        self.plant.enable()

    def _apply_command(self, command: Command) -> None:
        """Apply a valid command and feed the watchdog; any other command is ignored and feeds nothing."""
        if not command_fault(command, self.plant.robot_model.n):
            now = time.monotonic()
            if self._armed:
                self._longest_silence = max(self._longest_silence, now - self._last_command_at)
            self._last_command_at, self._armed, self._command_arrived = now, True, True
            self.plant.write(command)

    def _write_report(self) -> None:
        if not self._settings.report:
            return
        state = self.plant.read()
        report = RobotReport(
            last_command_at=self._last_command_at,
            drive_off_at=self._off_at,
            drive_off_cause=self._off_cause,
            travel=float(np.abs(state.q - self._off_q).max()),
            speed=float(np.abs(state.v).max()),
            resynchronizations=self._resynchronizations,
            ticks=self._ticks,
            judgement=self.world.judgement(),
            silent_periods=self._silent_periods,
            longest_silence=self._longest_silence,
            end=read_end_state(self.plant),
        )
        write_atomically(Path(self._settings.report), msgspec.json.encode(report))


def perception_period_ticks(period: float) -> int:
    """Ticks between two perceived scenes, for a robot with the control period `period` [s]."""
    return max(1, round(PERCEPTION_PERIOD / period))


def main(arguments: list[str], parent: ParentPipe) -> None:
    """Serve on the inherited sockets, whose numbers are the arguments, as a child of the gatekeeper."""
    link, control_link = inherited_links(arguments)
    settings = msgspec.json.decode(parent.read_settings(), type=SimulatedRobotSettings)
    process = RobotProcess(settings, link, control_link)
    if settings.report:
        parent.on_end(process.lose_gatekeeper)
    else:  # no report shows how the simulation continues
        parent.on_end(lambda: None, grace=0.0)
    process.serve()
