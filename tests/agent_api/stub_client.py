"""A client of a gatekeeper that accepts what the gate of a simulated cell accepts, and moves nothing."""

from __future__ import annotations

import time
from contextlib import contextmanager
from pathlib import Path
from threading import Event

from dualbrain.agent_api import robot as robot_module
from dualbrain.agent_api.connection import Connection
from dualbrain.agent_api.robot import Robot
from dualbrain.contracts.verdict import Accepted
from dualbrain.control.gatekeeper.protocol.messages import OutcomeReport, SceneReport, StatusReport, VerdictReport
from dualbrain.records import Outcome
from dualbrain.runtime.assembly import SimulatedCell

PERIOD = 0.02
"""Time between two looks at the state of the contract [s]."""


class StubClient:
    """Keeps the `executed` contracts and the `sent` operator commands; a contract lasts `motion` [s].

    With `reports` False, the gatekeeper has stopped: its last status remains, and nothing that is sent has an effect.
    """

    def __init__(self, cell: SimulatedCell) -> None:
        self._cell, self._aborted, self._end = cell, False, 0.0
        self.motion, self.reports, self.silence = 0.1, True, 0.0
        self.executed: list[str] = []
        self.sent: list[str] = []
        self.disconnected = Event()
        self._last = self._present_status()

    @property
    def now(self):
        return time.monotonic()

    @property
    def status(self):
        if self.reports:
            self._last = self._present_status()
        return self._last

    def _present_status(self):
        busy = bool(self.executed) and not self._aborted and time.monotonic() < self._end
        return StatusReport(now=time.monotonic(), action="NONE", cause="", check="", busy=busy, commander=True)

    def end_motion(self):
        self._end = 0.0

    def request_scene(self, timeout=5.0):
        model = self._cell.robot_model
        return SceneReport(
            now=time.monotonic(), scene=self._cell.loop.scene, q=tuple(model.home), opening=0.08, holding=""
        )

    def propose(self, data, scene_version):
        verdict = self._cell.check(data)
        if not isinstance(verdict, Accepted):
            return VerdictReport(sequence=1, rejected=verdict, gate_s=0.0)
        self.executed.append(verdict.contract.id)
        self._aborted, self._end = False, time.monotonic() + self.motion
        return VerdictReport(sequence=1, rejected=None, gate_s=0.0)

    def poll_outcome(self, timeout):
        time.sleep(min(timeout, PERIOD))
        if self._aborted or time.monotonic() > self._end:
            kind = "aborted" if self._aborted else "succeeded"
            return OutcomeReport(Outcome(kind=kind, reason="of the stub", duration=self.motion), {})
        return None

    def operate(self, act, speed=1.0):
        self.sent.append(act)
        self._aborted = self._aborted or self.reports

    def close(self):
        self.disconnected.set()


@contextmanager
def open_robot(client, cell, monkeypatch, **options):
    """A robot that commands `client`; its emergency stops are noted in `client.sent`."""
    monkeypatch.setattr(robot_module, "send_emergency_stop", lambda socket: client.sent.append("estop") or "")
    connection = Connection(
        client=client, robot_model=cell.robot_model, model_without_site=cell.robot_model, socket=Path("none")
    )
    defaults = {"planner": None, "ledger": None, "runs": None, "retries": None}
    robot = Robot(lambda receive, stack: connection, **defaults | options)
    try:
        yield robot
    finally:
        robot.close()
