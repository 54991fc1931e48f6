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
from dualbrain.control.gatekeeper.robot_link.packet_socket import Rubbish, Wire
from dualbrain.control.gatekeeper.robot_link.simulated_robot import WATCHDOG, looks_every
from dualbrain.core.geometry.shapes import Pose
from dualbrain.drivers.catalogue import driver_kind
from dualbrain.drivers.driver import Driver
from dualbrain.errors import InvalidSetup
from dualbrain.records import Scene, SceneObject
from dualbrain.robots.interface import Command
from dualbrain.robots.model import Body
from dualbrain.simulation.perception.noisy_perception import TABLE
from dualbrain.simulation.scenes.scene_spec import SceneSpec

ANSWER = 0.7
"""The share of a period for which the answer to a state is awaited."""
SURVEYED = 0.005
"""How far a surveyed thing may be from where the scene file says [m]."""


class DriverSettings(msgspec.Struct, frozen=True):
    """Which driver at which address, the body as the site narrows it, and what was surveyed."""

    driver: str
    address: str
    body: Body
    scene: SceneSpec


class DriverProcess:
    """A driver on one end of the wire."""

    def __init__(self, driver: Driver, scene: Scene, link: socket.socket) -> None:
        """Nothing moves; the drive is switched on when the gatekeeper says so."""
        self._driver, self._scene = driver, scene
        self._wire: Wire[packets.ToRobot] = Wire(link, packets.to_robot)
        self._asked_to_quit = self._answered = False
        self._heard, self._on = time.monotonic(), False
        self._ticks, self._joints = 0, len(driver.read().q)
        self._look_every = looks_every(driver.timing.period)

    def serve(self) -> None:
        """Until told to quit, or until the link is gone."""
        try:
            while self._wire.open and not self._asked_to_quit:
                self._driver.wait()
                self._tell()
                self._await_answer(time.monotonic() + ANSWER * self._driver.timing.period)
                if self._on and time.monotonic() - self._heard > WATCHDOG:
                    self._on = False
                    self._driver.stop()
        finally:
            self._driver.close()

    def _tell(self) -> None:
        state = self._driver.read()
        self._wire.send(packets.State.of(state))
        if self._ticks % self._look_every == 0:
            self._wire.send(packets.Seen(msgspec.structs.replace(self._scene, stamp=state.stamp)))
        self._ticks += 1

    def _await_answer(self, deadline: float) -> None:
        """Take in commands until one answers the state that was told, or time is up."""
        self._answered = False
        while self._wire.open and not self._answered and (left := deadline - time.monotonic()) > 0.0:
            if self._wire.wait(left):
                self._obey(self._wire.hear())

    def _cut(self) -> None:
        """What was heard is no packet for this arm: it stops, and goes on only when it is switched on again."""
        self._on = False
        self._driver.stop()

    def _obey(self, packet: packets.ToRobot | Rubbish | None) -> None:
        match packet:
            case Rubbish():
                self._cut()
            case packets.Write(u) if len(u) != self._joints:
                self._cut()
            case packets.Write(u, opening, force):
                self._heard = time.monotonic()
                self._driver.write(Command(np.array(u), opening, force))
                self._answered = True
            case packets.Switch(on):
                self._heard, self._on = time.monotonic(), on
                (self._driver.enable if on else self._driver.stop)()
            case packets.Quit():
                self._asked_to_quit = True
            case _:  # who judges a simulation, and what may be touched in it, means nothing to an arm
                pass


def surveyed(spec: SceneSpec) -> Scene:
    """The scene as it was surveyed; raises `InvalidSetup` if something in it moves, because nobody would see it."""
    if spec.mover is not None:
        raise InvalidSetup("scene for a real arm", got=f"{spec.mover.name}, which moves", allowed="things that stand")
    things = (
        SceneObject(
            thing.name, thing.role, thing.shape, Pose(thing.position, thing.quaternion), error=SURVEYED,
            category=thing.category, colour=thing.colour, fragile_limit=thing.fragile_limit,
        )
        for thing in spec.things
    )  # fmt: skip
    return Scene(spec.robot, 0.0, 1, (TABLE, *things), spec.places)


class Pace:
    """Holds a fake back to real time; what it has missed it does not make up for."""

    def __init__(self) -> None:
        """Not begun."""
        self._ahead = 0.0

    def __call__(self, now: float) -> None:
        """Until the fake's time `now` [s] has come."""
        early = self._ahead + now - time.monotonic()
        if abs(early) > WATCHDOG:
            self._ahead, early = time.monotonic() - now, 0.0
        if early > 0.0:
            time.sleep(early)


def main(arguments: list[str]) -> None:
    """Serve on the inherited socket."""
    link = socket.socket(fileno=int(arguments[0]))
    settings: Any = msgspec.json.decode(sys.stdin.buffer.readline(), type=DriverSettings)
    kind = driver_kind(settings.driver, settings.body.name)
    scene = surveyed(settings.scene)
    DriverProcess(kind.open(settings.address, settings.body, Pace()), scene, link).serve()


if __name__ == "__main__":
    main(sys.argv[1:])
