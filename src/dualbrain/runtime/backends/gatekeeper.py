"""Backend that runs the robot in real time behind a gatekeeper process."""

from __future__ import annotations

import time
from collections.abc import Callable, Generator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import msgspec

from dualbrain.contracts.gate.authorization import PLANNER
from dualbrain.control.gatekeeper.config import GatekeeperConfig
from dualbrain.control.gatekeeper.gatekeeper import OPERATOR
from dualbrain.control.gatekeeper.process import GatekeeperProcess
from dualbrain.control.gatekeeper.protocol.authentication import read_keys
from dualbrain.control.gatekeeper.protocol.client import ConnectionLostError, GatekeeperClient
from dualbrain.control.gatekeeper.protocol.emergency_stop import send_emergency_stop
from dualbrain.control.gatekeeper.protocol.messages import EventReport, Message, OperatorAction, TickReport
from dualbrain.control.gatekeeper.protocol.socket_folder import KEYS_NAME, SOCKET_NAME, socket_folder
from dualbrain.control.gatekeeper.remote_executor import RemoteExecutor
from dualbrain.control.gatekeeper.robot_link.simulated_robot import RobotReport
from dualbrain.control.recording.channels import OWN_RECORDING_LIMITS, read_trace
from dualbrain.control.recording.flight_log import FlightLog
from dualbrain.control.recording.trace import Event, Trace
from dualbrain.core.storage.atomic_files import write_atomically
from dualbrain.errors import ConfigurationError
from dualbrain.records import Judgement
from dualbrain.runtime.backends.backend import RunContext, RunningRobot
from dualbrain.runtime.config import RunObserver
from dualbrain.runtime.episode import GroundTruth
from dualbrain.runtime.planning.planning_time import PlanningClock
from dualbrain.simulation.plant.end_state import EndState

ROBOT_REPORT_FILE, TICK_TIMING_FILE = "robot.json", "punctuality.json"
"""Files that the robot process and the gatekeeper write into the run folder."""
ADDRESS_FILE = "gatekeeper.address"
"""File of the run folder with the address of the gatekeeper, for example for `dualbrain operate`."""


class GatekeeperBackend:
    """Starts a gatekeeper for a run. The filter cannot be switched off, and the plant of this process does not move."""

    def __init__(
        self,
        speed_scale: float = 1.0,
        on_tick_report: Callable[[TickReport], None] | None = None,
        registrations: Path | None = None,
    ) -> None:
        """Begin at the speed scale `speed_scale`, (0, 1]; `on_tick_report` gets the gatekeeper's tick reports.

        `on_reports_end` is called when no further report follows, before and after the gatekeeper is stopped. The
        gatekeeper is registered in the folder `registrations` while it runs (None: it is not).
        """
        self.speed_scale, self.on_tick_report, self.registrations = speed_scale, on_tick_report, registrations
        self.on_reports_end: Callable[[], None] | None = None
        self._operator: GatekeeperClient | None = None
        self._socket: Path | None = None

    def operate(self, action: OperatorAction, speed: float = 1.0) -> str:
        """Send an operator command, from any thread; returns "" or the reason why it could not be sent.

        An emergency stop has a connection of its own, so that it does not depend on those of the run.
        """
        if action == "estop" and self._socket is not None:
            return send_emergency_stop(self._socket)
        if self._operator is None or self._operator.disconnected.is_set():
            return "there is no gatekeeper"
        try:
            self._operator.operate(action, speed)
        except ConnectionLostError as error:
            return str(error)
        return ""

    @contextmanager
    def start(self, context: RunContext, observer: RunObserver) -> Generator[RunningRobot]:
        """The robot behind a new gatekeeper process; raises `ConfigurationError` for a run with camera images."""
        out = context.config.out
        if context.config.image:
            raise ConfigurationError.stating(
                "A robot behind a gatekeeper has no camera for the planner.", fix="Leave out --live or --image."
            )
        with ExitStack() as stack:
            folder = stack.enter_context(socket_folder())
            config = _gatekeeper_config(context, folder, self.speed_scale, self.registrations)
            self._socket = Path(config.socket)
            process = GatekeeperProcess(config)
            stack.callback(self._end_reports)
            stack.callback(process.stop)
            address = out / ADDRESS_FILE
            write_atomically(address, f"{config.socket}\n{config.keys}\n".encode())
            stack.callback(address.unlink, missing_ok=True)
            yield self._connect(context, observer, process)

    def _end_reports(self) -> None:
        if self.on_reports_end is not None:
            self.on_reports_end()

    def _connect(self, context: RunContext, observer: RunObserver, process: GatekeeperProcess) -> RunningRobot:
        config, model = process.config, context.robot_model

        def watch(message: Message) -> None:
            match message:
                case EventReport(t, kind, text, data):
                    observer.on_event(msgspec.convert({"t": t, "kind": kind, "text": text, "data": data}, Event))
                case TickReport() if self.on_tick_report:
                    self.on_tick_report(message)
                case _:
                    pass

        def judge() -> Judgement | None:
            """Read the judgement that the robot process writes when it is switched off."""
            self._end_reports()
            for one in (client, operator):
                one.close()
            process.stop()
            self._end_reports()  # a report may have been on its way
            report = _robot_report(context)
            return report.judgement if report else None

        where, keys = Path(config.socket), Path(config.keys)
        client = GatekeeperClient(where, read_keys(keys, (PLANNER,)), PLANNER, on_report=watch)
        self._operator = operator = GatekeeperClient(where, read_keys(keys, (OPERATOR,)), OPERATOR)
        log = FlightLog(Trace(model.n), None, observer.on_event, observer.on_attempt)
        executor = RemoteExecutor(model, client, log, context.interrupted)
        truth = GroundTruth(
            start_contract=lambda contract: None,
            judge=judge,
            versions=context.versions,
            image_features=context.image_features,
        )
        clock = PlanningClock(time.monotonic, measured=True)
        return RunningRobot(executor=executor, clock=clock, ground_truth=truth)

    def trace(self, context: RunContext) -> Trace:
        """The trace that the gatekeeper recorded."""
        return read_trace(context.config.out / "episode.mcap", OWN_RECORDING_LIMITS) or Trace(context.robot_model.n)

    def end_state(self, context: RunContext, held: str) -> EndState | None:
        """The state that the robot process reported at its end."""
        report = _robot_report(context)
        return msgspec.structs.replace(report.end, held=held) if report and report.end else None


def _robot_report(context: RunContext) -> RobotReport | None:
    """The report that the robot process wrote at its end; None if there is none."""
    path = context.config.out / ROBOT_REPORT_FILE
    return msgspec.json.decode(path.read_bytes(), type=RobotReport) if path.exists() else None


def _gatekeeper_config(
    context: RunContext, folder: Path, speed_scale: float, registrations: Path | None
) -> GatekeeperConfig:
    config, out = context.config, context.config.out
    return GatekeeperConfig(
        robot=config.robot,
        scene=context.spec,
        socket=str(folder / SOCKET_NAME),
        keys=str(folder / KEYS_NAME),
        seed=config.seed,
        goal=config.goal,
        speed_scale=speed_scale,
        recording=str(out / "episode.mcap"),
        instruction=config.instruction,
        report=str(out / ROBOT_REPORT_FILE),
        tick_timing=str(out / TICK_TIMING_FILE),
        site=str(config.site or ""),
        registrations=str(registrations or ""),
        started_by=f"`dualbrain run` {out.name}",
        unrecorded=config.unrecorded,
        start=context.start.robot if context.start else None,
        held=context.start.held if context.start else "",
    )
