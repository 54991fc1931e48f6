"""Executor that sends contracts to a gatekeeper over its socket and waits for the outcome.

Its gate forwards the raw bytes of a contract and returns the verdict of the gatekeeper's own gate.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass

import msgspec
import numpy as np

from dualbrain.contracts.contract import Contract, ContractHeader
from dualbrain.contracts.scene_names import SceneNames
from dualbrain.contracts.verdict import Accepted, Rejected, Verdict
from dualbrain.control.executor import Grants
from dualbrain.control.gatekeeper.protocol.client import REPLY_TIMEOUT, ConnectionLostError, GatekeeperClient
from dualbrain.control.gatekeeper.protocol.messages import OutcomeReport, RequestRefused
from dualbrain.control.recording.flight_log import FlightLog
from dualbrain.records import Outcome
from dualbrain.robots.interface import RobotState
from dualbrain.robots.model import RobotModel

SCENE_REQUEST_PERIOD = 0.1
"""Time [s] between two requests of the scene while an episode waits."""
SILENCE_LIMIT = 5.0
"""Time [s] without any message from the gatekeeper after which a contract is not waited for any more."""

INTERRUPTED = "the robot was stopped while the contract was on its way to the gate"
"""Reason of the rejection of a contract after an interruption."""
STOPS = ("aborted", "stopped")
"""Outcomes that an interruption can cause."""


class RemoteExecutor:
    """Executes contracts through a gatekeeper; implements `Executor`."""

    def __init__(
        self,
        robot_model: RobotModel,
        client: GatekeeperClient,
        log: FlightLog,
        interrupted: Callable[[], bool],
        *,
        interruption: Callable[[], str] = lambda: "",
    ) -> None:
        """Use `client`, and request the scene once.

        `interrupted`: whether a person wants the robot to stop, or the program ends; `interruption`: the reason for
        that, "" for the one that the gatekeeper gives.
        """
        self.robot_model, self.client, self.log, self.interrupted = robot_model, client, log, interrupted
        self._interruption = interruption
        self.refresh()

    def refresh(self, timeout: float = REPLY_TIMEOUT) -> None:
        """Request the newest scene and joint state, within `timeout` [s]."""
        report = self.client.request_scene(timeout)
        self.scene = report.scene
        self.state = RobotState(
            stamp=report.now,
            sequence=0,
            q=np.array(report.q),
            v=np.zeros(self.robot_model.n),
            opening=report.opening,
            finger_forces=(0.0, 0.0),
        )
        self.held_object = report.holding or None

    def gate(self, grants: Grants) -> RemoteGate:
        """The gatekeeper's own gate, which applies its own grants; `grants` is ignored."""
        del grants
        return RemoteGate(self.client, self.interrupted)

    def hold(self, duration: float, phase: str = "hold") -> None:
        """Wait for `duration` [s]; the gatekeeper holds the arm by itself."""
        del phase
        time.sleep(duration)
        if self.client.now - self.state.stamp > SCENE_REQUEST_PERIOD:
            self.refresh()

    def execute(self, contract: Contract) -> Outcome:
        """Wait for the outcome of the contract that the gatekeeper has accepted; a person may interrupt it.

        A scene that does not arrive in time ends nothing: as long as the gatekeeper sends anything, the contract may
        run, and its outcome follows. After `SILENCE_LIMIT` without a message the connection is closed, so that a
        gatekeeper that continues later stops the contract. A gatekeeper that ends after the contract, or because of it,
        may have sent the outcome before.
        """
        del contract
        try:
            ended = self._wait_for_outcome()
            with suppress(ConnectionLostError):
                self.refresh()
        except ConnectionLostError as error:
            ended = self._last_outcome()
            if ended is None:
                return self._with_interruption(
                    Outcome(kind="stopped", reason=f"the connection to the gatekeeper was lost: {error}")
                )
        self.log.binding.update(ended.binding)
        return self._with_interruption(ended.outcome)

    def _wait_for_outcome(self) -> OutcomeReport:
        """The outcome; sends one abort if a person interrupts. Raises `ConnectionLostError`."""
        abort_sent = False
        while True:
            if self.interrupted() and not abort_sent:
                self.client.operate("abort")
                abort_sent = True
            was_silent = self.client.silence >= SILENCE_LIMIT  # also after this process itself did not run
            if (ended := self.client.poll_outcome(SCENE_REQUEST_PERIOD)) is not None:
                return ended
            if was_silent and self.client.silence >= SILENCE_LIMIT:
                raise self.client.lose(f"the gatekeeper has not answered for {SILENCE_LIMIT:g} s")
            try:
                self.refresh(max(SILENCE_LIMIT - self.client.silence, SCENE_REQUEST_PERIOD))
            except ConnectionLostError:
                if self.client.disconnected.is_set():
                    raise

    def _last_outcome(self) -> OutcomeReport | None:
        """The outcome that arrived before the connection ended, None without one."""
        with suppress(ConnectionLostError):
            return self.client.poll_outcome(SCENE_REQUEST_PERIOD)
        return None

    def _with_interruption(self, outcome: Outcome) -> Outcome:
        """`outcome` with the reason of an interruption; a contract that ended by itself keeps its own."""
        reason = self._interruption()
        if reason and outcome.kind == "stopped":
            reason = f"{reason}, and {outcome.reason}"
        return msgspec.structs.replace(outcome, reason=reason) if reason and outcome.kind in STOPS else outcome


@dataclass(frozen=True, slots=True)
class RemoteGate:
    """A gate that forwards contracts to a gatekeeper, and none after an interruption."""

    client: GatekeeperClient
    interrupted: Callable[[], bool]

    def check(self, data: bytes, *, names: SceneNames, principal: str, now: float, header: ContractHeader) -> Verdict:
        """The gatekeeper's verdict on `data`; the arm starts to move as soon as it accepts."""
        del names, principal, now
        if self.interrupted():
            return _not_considered(INTERRUPTED)
        reply = self.client.propose(data, header.scene_version)
        if isinstance(reply, RequestRefused):
            return _not_considered(reply.reason)
        if reply.rejected is not None:
            return reply.rejected
        return Accepted(msgspec.json.decode(data, type=Contract))


def _not_considered(reason: str) -> Rejected:
    return Rejected(
        stage="authorization",
        pointer="",
        got=reason,
        allowed="a contract that is fit to be judged",
        hint="not considered",
    )
