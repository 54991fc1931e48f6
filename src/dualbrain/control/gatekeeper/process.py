"""Assembly of a gatekeeper from its configuration, and its start as a child process."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from pathlib import Path
from types import FrameType

import msgspec

from dualbrain.contracts.gate.authorization import PLANNER
from dualbrain.control.gatekeeper.config import GatekeeperConfig
from dualbrain.control.gatekeeper.deployment import Deployment
from dualbrain.control.gatekeeper.gate.exchange import GateSetup
from dualbrain.control.gatekeeper.gate.gate_process import GateProcess
from dualbrain.control.gatekeeper.gatekeeper import Gatekeeper, GatekeeperSettings
from dualbrain.control.gatekeeper.protocol.authentication import PRINCIPALS, load_keys
from dualbrain.control.gatekeeper.protocol.registration import registered
from dualbrain.control.gatekeeper.protocol.server import SocketServer, is_listening
from dualbrain.control.gatekeeper.robot_link.remote_robot import RemoteRobot
from dualbrain.control.gatekeeper.robot_link.threaded_robot import UNCOMPARED, ThreadedRobot
from dualbrain.control.gatekeeper.timing.tick_profile import TickProfiler
from dualbrain.control.gatekeeper.timing.tick_timing import TickTimingSummary
from dualbrain.control.recording.recorder import Recorder
from dualbrain.control.recording.recording_file import reserve_for_recording
from dualbrain.control.recording.trace import Trace
from dualbrain.core.processes.parent_pipe import PARENT_ENDED, ParentPipe, start_child
from dualbrain.core.processes.process_end import EndDeadline
from dualbrain.core.processes.realtime_priority import release_realtime_priority, request_realtime_priority
from dualbrain.core.storage.atomic_files import write_atomically
from dualbrain.errors import ConfigurationError

SWITCH_INTERVAL = 1e-4
"""Interval of the interpreter's thread switches [s]: the longest wait of the control tick for another thread."""
STARTUP_TIMEOUT = 60.0
"""Longest time [s] until a started gatekeeper listens."""
STOP_LIMIT = 1.4
"""Longest time [s] from a stop to the end of a child process which has a simulated robot and no file to complete."""
STOP_TIMEOUT = 15.0
"""Longest time [s] that a gatekeeper may take to end after it was asked to."""


def run_gatekeeper(
    config: GatekeeperConfig,
    on_ready: Callable[[], None] = lambda: None,
    parent: ParentPipe | None = None,
    on_warning: Callable[[str], None] = lambda text: None,
) -> TickTimingSummary:
    """Run a gatekeeper until the operator, SIGTERM or SIGINT shuts it down; returns the timing of its ticks.

    With a `parent`, it also ends when its parent does, after the arm has braked; if the robot is simulated and no file
    is written, both end after `STOP_LIMIT` even if something hangs. Without one, a person started it: it ignores
    SIGHUP, so it continues when its terminal closes. `on_ready` is called before the first tick, once robot and
    server are ready, and `on_warning` with each permission that a control thread lacks. Raises what
    `Deployment.from_config` raises, and `ConfigurationError` if the socket or the key file cannot be used.
    """
    if parent is None and signal.getsignal(signal.SIGHUP) is signal.SIG_DFL:
        signal.signal(signal.SIGHUP, signal.SIG_IGN)
    sys.setswitchinterval(SWITCH_INTERVAL)
    request_realtime_priority()
    registration = registered(
        Path(config.registrations) if config.registrations else None,
        robot=config.robot,
        socket=config.socket,
        keys=config.keys,
        started_by=config.started_by,
    )
    with ExitStack() as stack:
        stack.callback(release_realtime_priority)  # also if the setup is wrong
        deployment, profile = Deployment.from_config(config), TickProfiler()
        gatekeeper, robot = _assemble(config, deployment, profile, stack)

        deadline = EndDeadline(STOP_LIMIT, robot.process.kill, code=PARENT_ENDED)

        def begin_stop() -> None:
            gatekeeper.shut_down()
            if parent is not None and not _has_files(config):
                deadline.start()

        def stop(number: int, frame: FrameType | None) -> None:
            del number, frame
            begin_stop()

        for number in (signal.SIGTERM, signal.SIGINT, *((signal.SIGHUP,) if parent else ())):
            signal.signal(number, stop)
        if parent is not None:
            stack.callback(parent.on_end, lambda: None)
            parent.on_end(begin_stop)
        for text in robot.thread_status().warnings if isinstance(robot, ThreadedRobot) else ():
            on_warning(text)
        with registration:
            on_ready()
            gatekeeper.run()
        release_realtime_priority()
        thread = robot.thread_status() if isinstance(robot, ThreadedRobot) else None
        timing = msgspec.structs.replace(robot.tick_timer.summary(), parts=profile.summary(), control_thread=thread)
    if config.tick_timing:  # after the recording has released its reserved space
        write_atomically(Path(config.tick_timing), msgspec.json.encode(timing))
    return timing


def _assemble(
    config: GatekeeperConfig, deployment: Deployment, profile: TickProfiler, stack: ExitStack
) -> tuple[Gatekeeper, RemoteRobot]:
    """The gatekeeper with all its parts, ready to run; `stack` closes them, the robot first and the socket last."""
    robot_model, keys = deployment.robot_model, load_keys(Path(config.keys), PRINCIPALS)
    server = SocketServer(Path(config.socket))
    stack.callback(server.close)
    capabilities = {PLANNER: deployment.capability}
    gate = GateProcess(
        GateSetup(robot_model=robot_model, capabilities=capabilities, fixed_obstacles=deployment.fixed_obstacles)
    )
    stack.callback(gate.close)
    gate.wait_until_ready()  # before the robot, like the recorder: its states must not wait for a tick
    recorder, trace = None, Trace(robot_model.n, robot_model.nq)
    if config.recording:
        path = Path(config.recording)
        recorder = Recorder(path, trace, reserve=reserve_for_recording(path, unrecorded=config.unrecorded))
        stack.callback(recorder.close)
        recorder.episode(0.0, deployment.recording_metadata(config))
    process_settings, timing = deployment.process_settings(config), deployment.timing
    safety, monitor_limits = None, None
    if deployment.control_thread:
        robot = ThreadedRobot(process_settings, timing, profile)
        stack.callback(robot.close)
        safety, timing = (
            robot.make_filter(robot_model, deployment.filter_config, deployment.fixed_obstacles),
            robot.loop_timing,
        )
        monitor_limits = UNCOMPARED
    else:
        robot = RemoteRobot(process_settings, timing, profile)
        stack.callback(robot.close)
    gatekeeper = Gatekeeper(
        robot_model,
        robot,
        server,
        gate,
        keys,
        capabilities,
        settings=GatekeeperSettings(
            timing=timing,
            speed_scale=config.speed_scale,
            fixed_obstacles=deployment.fixed_obstacles,
            filter_config=deployment.filter_config,
            persons=deployment.persons,
            object_limits=deployment.object_limits,
            drive_initially_off=deployment.driver is not None,
            unrecorded=config.unrecorded,
            monitor_limits=monitor_limits,
        ),
        recorder=recorder,
        trace=trace,
        mark_part=profile.mark_part,
        safety=safety,
    )
    if config.start is not None:
        gatekeeper.loop.resume_grasp(config.held, config.start.target_opening, config.start.grip_force)
    return gatekeeper, robot


def _has_files(config: GatekeeperConfig) -> bool:
    """Whether files are written at the end, or a driver has to be closed."""
    return bool(config.recording or config.report or config.tick_timing or config.driver)


class GatekeeperProcess:
    """A gatekeeper as a child process, which ends with this process."""

    def __init__(self, config: GatekeeperConfig) -> None:
        """Start the process and wait until it listens; raises `ConfigurationError` if it does not start."""
        self.config = config
        self.process = start_child(__name__, msgspec.msgpack.encode(config), config.robot, config.socket)
        try:
            self._wait_until_listening()
        except BaseException:
            self.stop()
            raise

    def _wait_until_listening(self) -> None:
        deadline = time.monotonic() + STARTUP_TIMEOUT
        while (
            not (up := is_listening(Path(self.config.socket)))
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

    def request_stop(self) -> None:
        """Ask the process to brake the robot and to end, without waiting for it."""
        if self.process.poll() is None:
            self.process.terminate()

    def stop(self) -> None:
        """Terminate the process, which brakes the robot first; kill it if it does not end."""
        if self.process.poll() is None:
            self.process.terminate()
            with suppress(subprocess.TimeoutExpired):
                self.process.wait(timeout=STOP_TIMEOUT)
        if self.process.poll() is None:
            self.process.kill()
            self.process.wait()
        if self.process.stdin:
            self.process.stdin.close()


def main(arguments: list[str], parent: ParentPipe) -> None:
    """Run the gatekeeper of `GatekeeperProcess`; `arguments` (robot and socket) only identify it in process lists."""
    del arguments
    run_gatekeeper(msgspec.msgpack.decode(parent.read_settings(), type=GatekeeperConfig), parent=parent)
