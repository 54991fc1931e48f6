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
from dualbrain.control.gatekeeper.robot_link.packet_socket import Rubbish, Wire
from dualbrain.records import Judgement
from dualbrain.robots.interface import Command
from dualbrain.robots.loader import load_body
from dualbrain.robots.model import Body
from dualbrain.simulation.perception.noisy_perception import Noise, Perception
from dualbrain.simulation.plant.factory import open_plant
from dualbrain.simulation.scenes.scene_spec import SceneSpec
from dualbrain.simulation.tasks.multi_goal import errand_of
from dualbrain.simulation.world import SimulatedWorld

WATCHDOG = 0.1
"""No command for this long [s]: the drive goes off."""
AFTERMATH = 1.0
BEHIND = 0.1
"""When physics falls this far behind the clock [s], it goes on from there instead of racing after it."""
LOOK_EVERY = 0.033
"""Time between two pictures [s]."""


class Settings(msgspec.Struct, frozen=True):
    """What the robot process needs to know; `report` is written at the end ("" for none).

    `body` is the robot as a site narrows it, where there is one.
    """

    robot: str
    scene: SceneSpec
    seed: int = 0
    goal: str = ""
    report: str = ""
    body: Body | None = None


class Report(msgspec.Struct, frozen=True):
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

    def __init__(self, settings: Settings, link: socket.socket) -> None:
        """Build the world; nothing moves yet."""
        body, spec = settings.body or load_body(settings.robot), settings.scene
        self.plant = open_plant(spec, body)
        perception = Perception(spec, Noise(), np.random.default_rng([settings.seed, 1]))
        self.world = SimulatedWorld(
            self.plant, perception, goal=errand_of(settings.goal, spec) if settings.goal else None
        )
        self._wire: Wire[packets.ToRobot] = Wire(link, packets.to_robot)
        self._settings, self._period, self._asked_to_quit = settings, body.period, False
        self._look_every = looks_every(body.period)
        self._silent_at, self._armed = time.monotonic(), False
        self._off_at: float | None = None
        self._off_by, self._off_q = "", self.plant.read().q
        self._slips = self._ticks = 0

    def serve(self) -> None:
        """Run until told to quit or, without a link, until the aftermath is over."""
        due = time.monotonic()
        while not self._asked_to_quit and (self._wire.open or time.monotonic() - self._silent_at < AFTERMATH):
            self._hear()
            self._guard(time.monotonic())
            self._tick()
            due += self._period
            ahead = due - time.monotonic()
            if ahead > 0.0:
                self._wait(ahead, due)
            elif ahead < -BEHIND:
                due, self._slips = time.monotonic(), self._slips + 1
        self._leave()

    def _tick(self) -> None:
        self.world.advance()
        state = self.plant.read()
        self._wire.send(packets.State.of(state))
        if self._ticks % self._look_every == 0:
            self._wire.send(packets.Seen(self.world.look()))
        self._ticks += 1

    def _wait(self, ahead: float, due: float) -> None:
        """Until the next tick; a command that comes meanwhile is taken at once."""
        while ahead > 0.0:
            if self._wire.wait(ahead):
                self._hear()
            ahead = due - time.monotonic()

    def _guard(self, now: float) -> None:
        """The robot's own watchdog: armed by the first command, it knows nothing of orders, only of silence."""
        silent = self._armed and now - self._silent_at > WATCHDOG
        if self._off_at is None and (silent or not self._wire.open):
            self._cut("watchdog")

    def _cut(self, by: str) -> None:
        self.plant.stop()
        if self._off_at is None:
            self._off_at, self._off_by, self._off_q = time.monotonic(), by, self.plant.read().q

    def _hear(self) -> None:
        while (packet := self._wire.hear()) is not None:
            self._obey(packet)

    def _obey(self, packet: packets.ToRobot | Rubbish) -> None:
        match packet:
            case Rubbish():
                self._cut("rubbish")
            case packets.Write(u, opening, force):
                self._silent_at, self._armed = time.monotonic(), True
                if len(u) == self.plant.body.n and np.isfinite([*u, opening, force]).all():
                    self.plant.write(Command(np.array(u), opening, force))
            case packets.Switch(on=False):
                self._silent_at = time.monotonic()
                self._cut("order")
            case packets.Switch():
                self._silent_at, self._off_at = time.monotonic(), None
                self.plant.enable()
            case packets.Allow(phase, roles):
                self.world.allow(phase, roles)
            case packets.Begin(contract):
                self.world.begin(contract)
            case packets.Quit():
                self._asked_to_quit = True

    def _leave(self) -> None:
        if not self._settings.report:
            return
        state = self.plant.read()
        report = Report(
            self._silent_at, self._off_at, self._off_by, float(np.abs(state.q - self._off_q).max()),
            float(np.abs(state.v).max()), self._slips, self._ticks, self.world.judgement(),
        )  # fmt: skip
        Path(self._settings.report).write_bytes(msgspec.json.encode(report))


def looks_every(period: float) -> int:
    """Ticks from one picture to the next, for a robot whose states come every `period` [s]."""
    return max(1, round(LOOK_EVERY / period))


def main(arguments: list[str]) -> None:
    """Serve on the inherited socket."""
    link = socket.socket(fileno=int(arguments[0]))
    settings: Any = msgspec.json.decode(sys.stdin.buffer.readline(), type=Settings)
    RobotProcess(settings, link).serve()


if __name__ == "__main__":
    main(sys.argv[1:])
