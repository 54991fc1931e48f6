"""A driver as a process, in the place of the simulated robot: the same wire, the arm's own beat.

    python -m dualbrain.control.gatekeeper.robot_link.driver_process FD        (one line of settings on standard input)

Each joint state goes up as it comes; the command that answers it is awaited for most of a period and handed to the
driver. When the link is gone, or no command has come for `WATCHDOG`, the driver stops the arm; the arm's own watchdog
stands behind that. There is no camera here: the scene is the surveyed one, in which nothing may move; its things keep
the stamp of their survey, as nobody sees them anew.
"""

from __future__ import annotations

import socket
import sys
import time
from typing import Any

import msgspec
import numpy as np

from dualbrain.control.gatekeeper.robot_link import packets
from dualbrain.control.gatekeeper.robot_link.packet_socket import MalformedPacket, PacketSocket
from dualbrain.control.gatekeeper.robot_link.simulated_robot import WATCHDOG_TIMEOUT, perception_period_ticks
from dualbrain.core.geometry.shapes import Pose
from dualbrain.drivers.catalogue import find_driver_kind
from dualbrain.drivers.driver import Driver
from dualbrain.errors import ConfigurationError
from dualbrain.records import Scene, SceneObject
from dualbrain.robots.interface import Command
from dualbrain.robots.model import RobotModel
from dualbrain.simulation.perception.noisy_perception import TABLE_OBJECT
from dualbrain.simulation.scenes.scene_spec import SceneSpec

REPLY_FRACTION = 0.7
"""The share of a period for which the answer to a state is awaited."""
SURVEY_ERROR = 0.005
"""How far a surveyed thing may be from where the scene file says [m]."""


class DriverSettings(msgspec.Struct, frozen=True):
    """Which driver at which address, the body as the site narrows it, and what was surveyed."""

    driver: str
    address: str
    robot_model: RobotModel
    scene: SceneSpec


class DriverProcess:
    """A driver on one end of the wire."""

    def __init__(self, driver: Driver, scene: Scene, link: socket.socket) -> None:
        """Nothing moves; the drive is switched on when the gatekeeper says so."""
        self._driver, self._scene = driver, scene
        self._packet_socket: PacketSocket[packets.ToRobot] = PacketSocket(link, packets.decode_to_robot)
        self._shutdown_requested = self._command_received = False
        self._last_command_at, self._drive_on = time.monotonic(), False
        self._ticks, self._n_joints = 0, len(driver.read().q)
        self._scene_period_ticks = perception_period_ticks(driver.timing.period)

    def serve(self) -> None:
        """Until told to quit, or until the link is gone."""
        try:
            while self._packet_socket.is_open and not self._shutdown_requested:
                self._driver.wait()
                self._send_state()
                self._await_command(time.monotonic() + REPLY_FRACTION * self._driver.timing.period)
                if self._drive_on and time.monotonic() - self._last_command_at > WATCHDOG_TIMEOUT:
                    self._drive_on = False
                    self._driver.stop()
        finally:
            self._driver.close()

    def _send_state(self) -> None:
        state = self._driver.read()
        self._packet_socket.send(packets.StatePacket.from_state(state))
        if self._ticks % self._scene_period_ticks == 0:
            self._packet_socket.send(packets.ScenePacket(msgspec.structs.replace(self._scene, stamp=state.stamp)))
        self._ticks += 1

    def _await_command(self, deadline: float) -> None:
        """Take in commands until one answers the state that was told, or time is up."""
        self._command_received = False
        while (
            self._packet_socket.is_open and not self._command_received and (left := deadline - time.monotonic()) > 0.0
        ):
            if self._packet_socket.wait(left):
                self._apply_packet(self._packet_socket.receive())

    def _stop_drive(self) -> None:
        """What was heard is no packet for this arm: it stops, and goes on only when it is switched on again."""
        self._drive_on = False
        self._driver.stop()

    def _apply_packet(self, packet: packets.ToRobot | MalformedPacket | None) -> None:
        match packet:
            case MalformedPacket():
                self._stop_drive()
            case packets.CommandPacket(u) if len(u) != self._n_joints:
                self._stop_drive()
            case packets.CommandPacket(u, opening, force):
                self._last_command_at = time.monotonic()
                self._driver.write(Command(np.array(u), opening, force))
                self._command_received = True
            case packets.DrivePacket(on):
                self._last_command_at, self._drive_on = time.monotonic(), on
                (self._driver.enable if on else self._driver.stop)()
            case packets.ShutdownPacket():
                self._shutdown_requested = True
            case _:  # who judges a simulation, and what may be touched in it, means nothing to an arm
                pass


def surveyed_scene(spec: SceneSpec) -> Scene:
    """The scene as it was surveyed; raises `InvalidSetup` if something in it moves, because nobody would see it."""
    if spec.mover is not None:
        raise ConfigurationError(
            "scene for a real arm", got=f"{spec.mover.name}, which moves", allowed="things that stand"
        )
    things = (
        SceneObject(
            name=thing.name,
            role=thing.role,
            shape=thing.shape,
            pose=Pose(thing.position, thing.quaternion),
            error=SURVEY_ERROR,
            category=thing.category,
            colour=thing.colour,
            fragile_limit=thing.fragile_limit,
        )
        for thing in spec.objects
    )
    return Scene(robot=spec.robot, stamp=0.0, version=1, objects=(TABLE_OBJECT, *things), places=spec.places)


class RealTimePacer:
    """Holds a fake back to real time; what it has missed it does not make up for."""

    def __init__(self) -> None:
        """Not begun."""
        self._clock_offset = 0.0

    def __call__(self, now: float) -> None:
        """Until the fake's time `now` [s] has come."""
        early = self._clock_offset + now - time.monotonic()
        if abs(early) > WATCHDOG_TIMEOUT:
            self._clock_offset, early = time.monotonic() - now, 0.0
        if early > 0.0:
            time.sleep(early)


def main(arguments: list[str]) -> None:
    """Serve on the inherited socket."""
    link = socket.socket(fileno=int(arguments[0]))
    settings: Any = msgspec.json.decode(sys.stdin.buffer.readline(), type=DriverSettings)
    kind = find_driver_kind(settings.driver, settings.body.name)
    scene = surveyed_scene(settings.scene)
    DriverProcess(kind.open(settings.address, settings.body, RealTimePacer()), scene, link).serve()


if __name__ == "__main__":
    main(sys.argv[1:])
