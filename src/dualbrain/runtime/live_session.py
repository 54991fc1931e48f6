"""A session in two processes and real time: the cortex here, a gatekeeper of its own there, the robot beyond it."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

import msgspec

from dualbrain.contracts.gate.authorization import PLANNER
from dualbrain.control.gatekeeper.config import GatekeeperConfig
from dualbrain.control.gatekeeper.gatekeeper import OPERATOR
from dualbrain.control.gatekeeper.process import GatekeeperProcess
from dualbrain.control.gatekeeper.protocol.authentication import load_or_create_keys
from dualbrain.control.gatekeeper.protocol.client import ConnectionLostError, GatekeeperClient
from dualbrain.control.gatekeeper.protocol.messages import EventReport, Message, OperatorAction, TickReport
from dualbrain.control.gatekeeper.remote_executor import RemoteExecutor
from dualbrain.control.gatekeeper.robot_link.simulated_robot import RobotReport
from dualbrain.control.recording.channels import read_trace
from dualbrain.control.recording.flight_log import FlightLog
from dualbrain.control.recording.trace import Event, Trace
from dualbrain.records import FailureFeedback, Judgement
from dualbrain.runtime.episode import GroundTruth, run_episode
from dualbrain.runtime.planning_time import PlanningClock
from dualbrain.runtime.replanning import TryResult
from dualbrain.runtime.session import RunObserver, RunResult, Session
from dualbrain.simulation.scenes.scene_spec import save_scene

ROBOT_REPORT_FILE, TICK_TIMING_FILE = "robot.json", "punctuality.json"
"""What robot and gatekeeper leave in the run folder beside the recording."""
ADDRESS_FILE = "gatekeeper.address"
"""Where the run folder says how the gatekeeper is reached: by `dualbrain operate`, for instance."""


class LiveSession(Session):
    """As a session, but the arm is moved by a gatekeeper in real time; `stage` is the speed to begin with, (0, 1].

    The filter cannot be off here. The plant in this process stands still: it lends its pictures to the live view.
    """

    speed_stage: float = 1.0
    on_tick_report: Callable[[TickReport], None] | None = None
    _operator_client: GatekeeperClient | None = None

    def operate(self, act: OperatorAction, speed: float = 1.0) -> str:
        """A person's hand, from whichever thread; "" or why the gatekeeper could not be told."""
        if self._operator_client is None or self._operator_client.disconnected.is_set():
            return "there is no gatekeeper"
        try:
            self._operator_client.operate(act, speed)
        except ConnectionLostError as why:
            return str(why)
        return ""

    def run(self, observer: RunObserver) -> RunResult:
        """Run the instruction; the run folder holds config, scene, recording, robot's report and episode afterwards."""
        config, out = self.config, self.config.out
        out.joinpath("config.json").write_bytes(
            msgspec.json.format(msgspec.json.encode(config, enc_hook=str), indent=2)
        )
        save_scene(self.spec, out / "scene.json")
        self.interrupted_runs = self.ledger.start_run(
            out.name, {"instruction": config.instruction}, now=self.clocks.now()
        )
        with ExitStack() as stack:
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="dualbrain-")))
            plan = GatekeeperConfig(
                robot=config.robot,
                scene=self.spec,
                socket=str(folder / "door"),
                keys=str(folder / "keys"),
                seed=config.seed,
                goal=config.goal,
                stage=self.speed_stage,
                recording=str(out / "episode.mcap"),
                instruction=config.instruction,
                report=str(out / ROBOT_REPORT_FILE),
                punctuality=str(out / TICK_TIMING_FILE),
                site=str(config.site or ""),
            )
            process = GatekeeperProcess(plan)
            stack.callback(process.stop)
            out.joinpath(ADDRESS_FILE).write_text(f"{plan.socket}\n{plan.keys}\n", encoding="utf-8")
            stack.callback(out.joinpath(ADDRESS_FILE).unlink)
            tries = self._run_live_episodes(process, observer)
        return self._finish(tries, read_trace(out / "episode.mcap") or Trace(self.robot_model.n))

    def _run_live_episodes(self, process: GatekeeperProcess, onlooker: RunObserver) -> tuple[TryResult, ...]:
        config, plan = self.config, process.config

        def watch(message: Message) -> None:
            match message:
                case EventReport(t, kind, text, data):
                    onlooker.on_event(msgspec.convert({"t": t, "kind": kind, "text": text, "data": data}, Event))
                case TickReport() if self.on_tick_report:
                    self.on_tick_report(message)
                case _:
                    pass

        def judge() -> Judgement | None:
            """Truth is asked for when all is over: the robot writes it down as it is switched off."""
            for one in (link, hand):
                one.close()
            process.stop()
            report = config.out / ROBOT_REPORT_FILE
            return msgspec.json.decode(report.read_bytes(), type=RobotReport).judgement if report.exists() else None

        keys = load_or_create_keys(Path(plan.keys))
        link = GatekeeperClient(Path(plan.socket), keys, PLANNER, on_report=watch)
        self._operator_client = hand = GatekeeperClient(Path(plan.socket), keys, OPERATOR)
        log = FlightLog(Trace(self.robot_model.n), None, onlooker.on_event)
        layer = RemoteExecutor(
            robot_model=self.robot_model, client=link, log=log, interrupted=lambda: self._stop_requested
        )
        thinking = PlanningClock(time.monotonic, measured=True)
        witness = GroundTruth(lambda contract: None, judge, self._versions(), self._image_features)

        def run(name: str, left: int, setback: FailureFeedback | None) -> TryResult:
            return run_episode(
                self._episode_request(name, left, setback),
                self.planner,
                self.memory,
                layer,
                thinking,
                witness,
                self._save_episode,
                now=self.clocks.now(),
                retrieve_passages=self._retrieve_passages,
            )

        return self._run_tries(log, lambda: layer.state.stamp, run)
