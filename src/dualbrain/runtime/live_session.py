"""A session in two processes and real time: the cortex here, a gatekeeper of its own there, the robot beyond it."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

import msgspec

from dualbrain.contracts.gate.authorization import PLANNER
from dualbrain.control.gatekeeper.config import Plan
from dualbrain.control.gatekeeper.gatekeeper import OPERATOR
from dualbrain.control.gatekeeper.process import Process
from dualbrain.control.gatekeeper.protocol.authentication import open_keys
from dualbrain.control.gatekeeper.protocol.client import GatekeeperLink, LinkLost
from dualbrain.control.gatekeeper.protocol.messages import Act, Glimpse, Message, News
from dualbrain.control.gatekeeper.remote_executor import RemoteLayer
from dualbrain.control.gatekeeper.robot_link.simulated_robot import Report
from dualbrain.control.recording.channels import read_trace
from dualbrain.control.recording.flight_log import FlightLog
from dualbrain.control.recording.trace import Event, Trace
from dualbrain.records import Judgement, Setback
from dualbrain.runtime.episode import Witness, run_episode
from dualbrain.runtime.planning_time import Thinking
from dualbrain.runtime.replanning import Tried
from dualbrain.runtime.session import Finished, Onlooker, Session
from dualbrain.simulation.scenes.scene_spec import save_scene

REPORT, PUNCTUALITY = "robot.json", "punctuality.json"
"""What robot and gatekeeper leave in the run folder beside the recording."""
ADDRESS = "gatekeeper.address"
"""Where the run folder says how the gatekeeper is reached: by `dualbrain operate`, for instance."""


class LiveSession(Session):
    """As a session, but the arm is moved by a gatekeeper in real time; `stage` is the speed to begin with, (0, 1].

    The filter cannot be off here. The plant in this process stands still: it lends its pictures to the live view.
    """

    stage: float = 1.0
    glimpse: Callable[[Glimpse], None] | None = None
    _hand: GatekeeperLink | None = None

    def operate(self, act: Act, speed: float = 1.0) -> str:
        """A person's hand, from whichever thread; "" or why the gatekeeper could not be told."""
        if self._hand is None or self._hand.lost.is_set():
            return "there is no gatekeeper"
        try:
            self._hand.operate(act, speed)
        except LinkLost as why:
            return str(why)
        return ""

    def run(self, onlooker: Onlooker) -> Finished:
        """Run the instruction; the run folder holds config, scene, recording, robot's report and episode afterwards."""
        config, out = self.config, self.config.out
        out.joinpath("config.json").write_bytes(
            msgspec.json.format(msgspec.json.encode(config, enc_hook=str), indent=2)
        )
        save_scene(self.spec, out / "scene.json")
        self.interrupted = self.ledger.start_run(out.name, {"instruction": config.instruction}, now=self.times.now())
        with ExitStack() as stack:
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="dualbrain-")))
            plan = Plan(
                config.robot, self.spec, str(folder / "door"), str(folder / "keys"), config.seed, config.goal,
                self.stage, recording=str(out / "episode.mcap"), instruction=config.instruction,
                report=str(out / REPORT), punctuality=str(out / PUNCTUALITY), site=str(config.site or ""),
            )  # fmt: skip
            process = Process(plan)
            stack.callback(process.stop)
            out.joinpath(ADDRESS).write_text(f"{plan.socket}\n{plan.keys}\n", encoding="utf-8")
            stack.callback(out.joinpath(ADDRESS).unlink)
            tries = self._live(process, onlooker)
        return self._finished(tries, read_trace(out / "episode.mcap") or Trace(self.body.n))

    def _live(self, process: Process, onlooker: Onlooker) -> tuple[Tried, ...]:
        config, plan = self.config, process.plan

        def watch(message: Message) -> None:
            match message:
                case News(t, kind, text, data):
                    onlooker.event(msgspec.convert({"t": t, "kind": kind, "text": text, "data": data}, Event))
                case Glimpse() if self.glimpse:
                    self.glimpse(message)
                case _:
                    pass

        def judge() -> Judgement | None:
            """Truth is asked for when all is over: the robot writes it down as it is switched off."""
            for one in (link, hand):
                one.close()
            process.stop()
            report = config.out / REPORT
            return msgspec.json.decode(report.read_bytes(), type=Report).judgement if report.exists() else None

        keys = open_keys(Path(plan.keys))
        link = GatekeeperLink(Path(plan.socket), keys, PLANNER, watch=watch)
        self._hand = hand = GatekeeperLink(Path(plan.socket), keys, OPERATOR)
        log = FlightLog(Trace(self.body.n), None, onlooker.event)
        layer = RemoteLayer(self.body, link, log, lambda: self._interrupted)
        thinking = Thinking(time.monotonic, measured=True)
        witness = Witness(lambda contract: None, judge, self._versions(), self._picture)

        def run(name: str, left: int, setback: Setback | None) -> Tried:
            return run_episode(
                self._errand(name, left, setback), self.planner, self.memory, layer, thinking, witness, self._keep,
                now=self.times.now(), look_up=self._look_up,
            )  # fmt: skip

        return self._tried(log, lambda: layer.state.stamp, run)
