"""The process of a driver, which replaces the simulated robot: the same packets, at the arm's own control period.

The process sends each joint state as it arrives, waits for its command for most of a period and passes the command to
the driver. If the link is closed, the gatekeeper has ended, or no valid command arrives for `WATCHDOG_TIMEOUT`, the
driver stops the arm; the arm's own watchdog is a second safeguard. There is no camera: the scene is the surveyed one,
in which no object may move. Its objects keep the stamp of their survey.
"""

from __future__ import annotations

import logging
import socket
import time

import msgspec
import numpy as np

from dualbrain.control.gatekeeper.robot_link import packets
from dualbrain.control.gatekeeper.robot_link.control_link import ControlLink, ThreadCommand, inherited_links
from dualbrain.control.gatekeeper.robot_link.packet_socket import MalformedPacket, PacketSocket
from dualbrain.control.gatekeeper.robot_link.simulated_robot import WATCHDOG_TIMEOUT, perception_period_ticks
from dualbrain.core.geometry.shapes import Pose
from dualbrain.core.processes.parent_pipe import ParentPipe
from dualbrain.core.processes.real_time_pacer import RealTimePacer
from dualbrain.drivers.catalogue import find_driver_kind
from dualbrain.drivers.driver import Driver, command_fault
from dualbrain.drivers.franka import Realtime
from dualbrain.errors import ConfigurationError
from dualbrain.records import Scene, SceneObject
from dualbrain.robots.interface import Command
from dualbrain.robots.model import RobotModel
from dualbrain.simulation.perception.noisy_perception import TABLE_OBJECT
from dualbrain.simulation.scenes.scene_spec import SceneSpec

logger = logging.getLogger(__name__)

REPLY_FRACTION = 0.7
"""Fraction of a period that the process waits for the command for a state."""
MAX_LATE_PACKETS = 64
"""Most packets that the process reads before it sends a state."""
SURVEY_ERROR = 0.005
"""Bound on the position error of a surveyed object [m]."""


class DriverSettings(msgspec.Struct, frozen=True, kw_only=True):
    """The driver and its address, the robot with the limits of its site, and the surveyed scene."""

    driver: str
    address: str
    robot_model: RobotModel
    scene: SceneSpec
    realtime: Realtime = "enforce"


class DriverProcess:
    """A driver at one end of the robot link."""

    def __init__(
        self, driver: Driver, scene: Scene, link: socket.socket, control_link: ControlLink | None = None
    ) -> None:
        """Connect the parts; the drive remains off until the gatekeeper switches it on.

        With a `control_link` a control thread commands the joints and the drive, and the gatekeeper the gripper.
        """
        self._driver, self._scene, self._control_link = driver, scene, control_link
        self._packet_socket: PacketSocket[packets.ToRobot] = PacketSocket(link, packets.decode_to_robot)
        self._shutdown_requested = self._command_received = False
        self._last_command_at, self._drive_on = time.monotonic(), False
        self._faults: tuple[str, ...] = ()
        self._ticks, self._n_joints = 0, len(driver.read().q)
        self._scene_period_ticks = perception_period_ticks(driver.timing.period)

    def lose_gatekeeper(self) -> None:
        """Stop serving, from any thread: the gatekeeper has ended."""
        self._packet_socket.mark_closed()

    def serve(self) -> None:
        """Run until shutdown, or until the link is closed."""
        try:
            while self._packet_socket.is_open and not self._shutdown_requested:
                self._driver.wait()
                if self._control_link is not None:
                    self._receive_thread_commands(self._control_link, write=False)
                elif self._driver.read().desired_v is not None:
                    self._drop_late_commands()
                self._send_state()
                self._await_command(time.monotonic() + REPLY_FRACTION * self._driver.timing.period)
                self._check_drive()
                self._log_faults()
        finally:
            self._driver.close()

    def _log_faults(self) -> None:
        """Log the reasons of the arm for a drive that is off, once."""
        faults = self._driver.faults()
        if faults and faults != self._faults:
            logger.warning("The arm has switched its drive off: %s", "; ".join(faults))
        self._faults = faults

    def _send_state(self) -> None:
        state = self._driver.read()
        if self._control_link is not None:
            self._control_link.send_state(state)
        self._packet_socket.send(packets.StatePacket.from_state(state))
        if self._ticks % self._scene_period_ticks == 0:
            self._packet_socket.send(packets.ScenePacket(msgspec.structs.replace(self._scene, stamp=state.stamp)))
        self._ticks += 1

    def _drop_late_commands(self) -> None:
        """Apply what arrived since the last command, except for commands: their period is over.

        An arm that reports the executed command has continued the one before by itself. A late command would contradict
        it, and each later one would be written one period late.
        """
        for _ in range(MAX_LATE_PACKETS):
            packet = self._packet_socket.receive()
            if packet is None:
                return
            if not isinstance(packet, packets.CommandPacket):
                self._apply_packet(packet)
            elif command_fault(Command(np.array(packet.u, dtype=float), packet.opening, packet.force), self._n_joints):
                self._stop_drive()
            else:
                self._last_command_at = time.monotonic()

    def _await_command(self, deadline: float) -> None:
        """Apply packets until a command arrives for the sent state, at most until `deadline`."""
        self._command_received = False
        if self._control_link is not None:
            self._await_thread_command(self._control_link, deadline)
            return
        while (
            self._packet_socket.is_open and not self._command_received and (left := deadline - time.monotonic()) > 0.0
        ):
            if self._packet_socket.wait(left):
                self._apply_packet(self._packet_socket.receive())

    def _await_thread_command(self, control_link: ControlLink, deadline: float) -> None:
        """Apply what the gatekeeper sent, and then the newest command of its thread for the sent state."""
        for _ in range(MAX_LATE_PACKETS):
            if (packet := self._packet_socket.receive()) is None:
                break
            self._apply_packet(packet)
        while (
            self._packet_socket.is_open and not self._command_received and (left := deadline - time.monotonic()) > 0.0
        ):
            if control_link.wait(left):
                self._receive_thread_commands(control_link, write=True)

    def _receive_thread_commands(self, control_link: ControlLink, *, write: bool) -> None:
        """Switch the drive as the commands that have arrived demand, and write the newest one if it is to be written.

        A command from before the drive was switched on is not written.
        """
        received = control_link.receive()
        if isinstance(received, MalformedPacket):
            self._stop_drive()
        elif received is not None:
            if received.switched is not None:
                self._switch_drive(on=received.switched)
            self._follow_thread(control_link, received.command, write=write and not received.switched)

    def _follow_thread(self, control_link: ControlLink, command: ThreadCommand, *, write: bool) -> None:
        """Feed the watchdog with a valid command of the thread, and write it; any other command stops the arm."""
        if command_fault(Command(command.u, 0.0, 0.0), self._n_joints):
            self._stop_drive()
            return
        self._last_command_at = time.monotonic()
        if write and (whole := control_link.complete(command)) is not None:
            self._apply_command(whole)

    def _switch_drive(self, *, on: bool) -> None:
        first, self._drive_on = on and not self._drive_on, on
        (self._driver.enable if on else self._driver.stop)()
        if first:  # a repeated order is no command and does not feed the watchdog; an arm may take time to switch on
            self._last_command_at = time.monotonic()

    def _check_drive(self) -> None:
        """Stop a drive without commands, and one that came on although it is to be off."""
        if self._drive_on and time.monotonic() - self._last_command_at > WATCHDOG_TIMEOUT:
            self._stop_drive()
        elif not self._drive_on and self._driver.read().drive_enabled:
            self._driver.stop()

    def _stop_drive(self) -> None:
        """Stop after a packet that this arm cannot use; the drive remains off until it is switched on again."""
        self._drive_on = False
        self._driver.stop()

    def _apply_command(self, command: Command) -> None:
        """Pass a valid command to the driver and feed the watchdog; any other command stops the arm."""
        if command_fault(command, self._n_joints):
            self._stop_drive()
            return
        self._last_command_at, self._command_received = time.monotonic(), True
        self._driver.write(command)

    def _apply_packet(self, packet: packets.ToRobot | MalformedPacket | None) -> None:
        match packet:
            case MalformedPacket():
                self._stop_drive()
            case packets.CommandPacket(u, opening, force):
                command = Command(np.array(u, dtype=float), opening, force)
                if self._control_link is not None:
                    self._control_link.set_gripper(command)
                else:
                    self._apply_command(command)
            case packets.DrivePacket(on):
                self._switch_drive(on=on)
            case packets.ShutdownPacket():
                self._shutdown_requested = True
            case _:  # phases and contracts are for the monitor and the judge of a simulation
                pass


def surveyed_scene(spec: SceneSpec) -> Scene:
    """The surveyed scene; raises `ConfigurationError` if an object in it moves, because no camera would detect it."""
    if spec.mover is not None:
        raise ConfigurationError.stating(
            f"{spec.mover.name} moves, but the scene of a real arm must not change.", fix="Name a scene without it."
        )
    objects = (
        SceneObject(
            name=obj.name,
            role=obj.role,
            shape=obj.shape,
            pose=Pose(obj.position, obj.quaternion),
            error=SURVEY_ERROR,
            category=obj.category,
            colour=obj.colour,
            fragile_limit=obj.fragile_limit,
        )
        for obj in spec.objects
    )
    return Scene(robot=spec.robot, stamp=0.0, version=1, objects=(TABLE_OBJECT, *objects), places=spec.places)


def main(arguments: list[str], parent: ParentPipe) -> None:
    """Serve on the inherited sockets, whose numbers are the arguments, as a child of the gatekeeper."""
    link, control_link = inherited_links(arguments)
    settings = msgspec.json.decode(parent.read_settings(), type=DriverSettings)
    kind = find_driver_kind(settings.driver, settings.robot_model.name)
    scene = surveyed_scene(settings.scene)
    pace = RealTimePacer(tolerance=WATCHDOG_TIMEOUT)  # of a fake arm
    driver = kind.open(settings.address, settings.robot_model, pace, realtime=settings.realtime)
    process = DriverProcess(driver, scene, link, control_link)
    parent.on_end(process.lose_gatekeeper)
    process.serve()
