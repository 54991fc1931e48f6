"""Assembly of a gatekeeper from its configuration, and its start as a child process."""

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
from dualbrain.control.gatekeeper.config import GatekeeperConfig
from dualbrain.control.gatekeeper.deployment import Deployment
from dualbrain.control.gatekeeper.gate.exchange import GateSetup
from dualbrain.control.gatekeeper.gate.gate_process import GateProcess
from dualbrain.control.gatekeeper.gatekeeper import Gatekeeper, GatekeeperSettings
from dualbrain.control.gatekeeper.protocol.authentication import load_or_create_keys
from dualbrain.control.gatekeeper.protocol.server import SocketServer, is_listening
from dualbrain.control.gatekeeper.robot_link.remote_robot import RemoteRobot
from dualbrain.control.gatekeeper.timing.tick_profile import TickProfiler
from dualbrain.control.gatekeeper.timing.tick_timing import TickTimingSummary
from dualbrain.control.recording.recorder import Recorder
from dualbrain.control.recording.trace import Trace
from dualbrain.errors import ConfigurationError

SWITCH_INTERVAL = 1e-4
"""Interval of the interpreter's thread switches [s]: the longest wait of the control tick for another thread."""
STARTUP_TIMEOUT = 60.0
"""Longest time [s] until a started gatekeeper listens."""


def run_gatekeeper(config: GatekeeperConfig, on_ready: Callable[[], None] = lambda: None) -> TickTimingSummary:
    """Run a gatekeeper until the operator, SIGTERM or SIGINT shuts it down; returns the timing of its ticks.

    `on_ready` is called before the first tick, once robot and server are ready. Raises what `Deployment.from_config`
    raises, and `ConfigurationError` if the socket or the key file cannot be used.
    """
    sys.setswitchinterval(SWITCH_INTERVAL)
    _request_realtime_priority()
    deployment, keys = Deployment.from_config(config), load_or_create_keys(Path(config.keys))
    robot_model = deployment.robot_model
    server = SocketServer(Path(config.socket))
    robot: RemoteRobot | None = None
    gate: GateProcess | None = None
    recorder: Recorder | None = None
    try:
        gate = GateProcess(
            GateSetup(
                robot_model=robot_model,
                capabilities={PLANNER: deployment.capability},
                fixed_obstacles=deployment.fixed_obstacles,
            )
        )
        profile = TickProfiler()
        robot = RemoteRobot(deployment.process_settings(config), deployment.timing, profile)
        trace = Trace(robot_model.n, robot_model.nq)
        if config.recording:
            recorder = Recorder(Path(config.recording), trace)
            recorder.episode(0.0, deployment.recording_metadata(config))
        settings = GatekeeperSettings(
            timing=deployment.timing,
            speed_scale=config.speed_scale,
            fixed_obstacles=deployment.fixed_obstacles,
            filter_config=deployment.filter_config,
            drive_initially_off=deployment.driver is not None,
        )
        gatekeeper = Gatekeeper(
            robot_model,
            robot,
            server,
            gate,
            keys,
            {PLANNER: deployment.capability},
            settings=settings,
            recorder=recorder,
            trace=trace,
            mark_part=profile.mark_part,
        )

        def stop(number: int, frame: FrameType | None) -> None:
            del number, frame
            gatekeeper.shut_down()

        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, stop)
        gate.wait_until_ready()
        on_ready()
        gatekeeper.run()
        timing = msgspec.structs.replace(robot.tick_timer.summary(), parts=profile.summary())
        if config.tick_timing:
            Path(config.tick_timing).write_bytes(msgspec.json.encode(timing))
        return timing
    finally:
        if robot is not None:
            robot.close()
        if gate is not None:
            gate.close()
        if recorder is not None:
            recorder.close()
        server.close()


class GatekeeperProcess:
    """A gatekeeper as a child process."""

    def __init__(self, config: GatekeeperConfig) -> None:
        """Start the process and wait until it listens; raises `ConfigurationError` if it does not start."""
        flags = ["-S"] if sys.flags.no_site else []
        self.config = config
        self.process = subprocess.Popen(
            [sys.executable, *flags, "-m", "dualbrain.control.gatekeeper.process"],
            stdin=subprocess.PIPE,
            start_new_session=True,
        )
        if self.process.stdin:
            self.process.stdin.write(msgspec.msgpack.encode(config))
            self.process.stdin.close()
        deadline = time.monotonic() + STARTUP_TIMEOUT
        while (
            not (up := is_listening(Path(config.socket)))
            and self.process.poll() is None
            and time.monotonic() < deadline
        ):
            time.sleep(0.02)
        if not up:
            code = self.process.poll()
            happened = f"did not listen within {STARTUP_TIMEOUT:.0f} s" if code is None else f"exited with code {code}"
            raise ConfigurationError.stating(
                f"The gatekeeper process {happened}.", fix="See its messages on standard error."
            )

    def stop(self) -> None:
        """Terminate the process, which brakes the robot first; kill it if it does not end."""
        if self.process.poll() is None:
            self.process.terminate()
            with suppress(subprocess.TimeoutExpired):
                self.process.wait(timeout=15.0)
        if self.process.poll() is None:
            self.process.kill()
            self.process.wait()


def _request_realtime_priority() -> None:
    """Request a real-time priority; without one, the tick timing shows the effect."""
    with suppress(OSError, AttributeError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(10))


if __name__ == "__main__":
    run_gatekeeper(msgspec.msgpack.decode(sys.stdin.buffer.read(), type=GatekeeperConfig))
