"""Putting a gatekeeper together: settings, robot, door, keys; and starting one as a process of its own."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from types import FrameType

import msgspec

from dualbrain.contracts.gate.authorization import PLANNER
from dualbrain.control.gatekeeper.config import Plan
from dualbrain.control.gatekeeper.deployment import Place
from dualbrain.control.gatekeeper.gatekeeper import Gatekeeper
from dualbrain.control.gatekeeper.protocol.authentication import open_keys
from dualbrain.control.gatekeeper.protocol.server import Door, listens
from dualbrain.control.gatekeeper.robot_link.remote_robot import RemoteRobot
from dualbrain.control.gatekeeper.timing.tick_profile import Laps
from dualbrain.control.gatekeeper.timing.tick_timing import Punctuality
from dualbrain.control.recording.recorder import Recorder
from dualbrain.control.recording.trace import Trace
from dualbrain.errors import InvalidSetup

SWITCH = 1e-4
"""How long another thread may keep the interpreter from the control tick [s]."""
START = 60.0


def keep(plan: Plan, ready: Callable[[], None] = lambda: None) -> Punctuality:
    """Be the gatekeeper until told to shut down (by the operator, SIGTERM or SIGINT); how punctual it was.

    `ready` is called once robot and door are there and nothing was refused, before the first tick.
    """
    sys.setswitchinterval(SWITCH)
    _ask_for_real_time()
    place, keys = Place.of(plan), open_keys(Path(plan.keys))
    body = place.body
    door = Door(Path(plan.socket))
    robot: RemoteRobot | None = None
    recorder: Recorder | None = None
    try:
        laps = Laps()
        robot = RemoteRobot(place.settings(plan), place.timing, laps)
        trace = Trace(body.n, body.width)
        if plan.recording:
            recorder = Recorder(Path(plan.recording), trace)
            recorder.episode(0.0, place.about(plan))
        keeper = Gatekeeper(
            body, robot, door, keys, {PLANNER: place.capability}, timing=place.timing, recorder=recorder, trace=trace,
            stage=plan.stage, standing=place.standing, config=place.config, off_at_first=place.kind is not None,
            lap=laps.lap,
        )  # fmt: skip

        def stop(number: int, frame: FrameType | None) -> None:
            del number, frame
            keeper.shut_down()

        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, stop)
        ready()
        keeper.run()
        punctuality = msgspec.structs.replace(robot.metronome.summary(), parts=laps.summary())
        if plan.punctuality:
            Path(plan.punctuality).write_bytes(msgspec.json.encode(punctuality))
        return punctuality
    finally:
        if robot is not None:
            robot.close()
        if recorder is not None:
            recorder.close()
        door.close()


class Process:
    """A gatekeeper as a child process."""

    def __init__(self, plan: Plan) -> None:
        """Start it and wait until it listens; raises `InvalidSetup` if it does not come up."""
        flags = ["-S"] if sys.flags.no_site else []
        self.plan = plan
        self.process = subprocess.Popen(
            [sys.executable, *flags, "-m", "dualbrain.control.gatekeeper.process"], stdin=subprocess.PIPE,
            start_new_session=True,
        )  # fmt: skip
        if self.process.stdin:
            self.process.stdin.write(msgspec.msgpack.encode(plan))
            self.process.stdin.close()
        deadline = time.monotonic() + START
        while not (up := listens(Path(plan.socket))) and self.process.poll() is None and time.monotonic() < deadline:
            time.sleep(0.02)
        if not up:
            raise InvalidSetup("gatekeeper", got=f"exit code {self.process.poll()}", allowed="one that comes up")

    def stop(self) -> None:
        """Ask it to brake and leave; insist if it does not."""
        if self.process.poll() is None:
            self.process.terminate()
            with suppress(subprocess.TimeoutExpired):
                self.process.wait(timeout=15.0)
        if self.process.poll() is None:
            self.process.kill()
            self.process.wait()


def _ask_for_real_time() -> None:
    """A real-time priority where the system grants one; where it does not, the histogram tells."""
    with suppress(OSError, AttributeError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(10))


if __name__ == "__main__":
    keep(msgspec.msgpack.decode(sys.stdin.buffer.read(), type=Plan))
