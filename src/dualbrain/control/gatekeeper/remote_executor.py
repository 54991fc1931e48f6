"""The local layer as the cortex sees it: over the socket. It shows what the planner needs, and carries nothing out.

The gate here is a messenger: it sends the raw bytes and brings back the word of the gatekeeper's own gate.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field

import msgspec
import numpy as np

from dualbrain.contracts.contract import Contract, ContractHeader
from dualbrain.contracts.scene_names import SceneNames
from dualbrain.contracts.verdict import Accepted, Rejected, Verdict
from dualbrain.control.gatekeeper.protocol.client import ConnectionLostError, GatekeeperClient
from dualbrain.control.gatekeeper.protocol.messages import RequestRefused
from dualbrain.control.recording.flight_log import FlightLog
from dualbrain.records import Outcome
from dualbrain.robots.interface import RobotState
from dualbrain.robots.model import RobotModel

SCENE_REQUEST_PERIOD = 0.1
"""How often the scene is asked for while somebody waits [s]."""


@dataclass(slots=True)
class HeldObject:
    """What is held, by name."""

    name: str


@dataclass(slots=True)
class GripperState:
    """The part of a limb that a planner hears of."""

    holding: HeldObject | None = None


@dataclass(kw_only=True)
class RemoteExecutor:
    """Has what `run_episode` asks of a local layer; `interrupted` says that a person wants it to stop."""

    robot_model: RobotModel
    client: GatekeeperClient
    log: FlightLog
    interrupted: Callable[[], bool]
    controller: GripperState = field(default_factory=GripperState)

    def __post_init__(self) -> None:
        """Look once."""
        self.refresh()

    def refresh(self) -> None:
        """Ask for what there is to be seen."""
        sight = self.client.request_scene()
        self.scene = sight.scene
        self.state = RobotState(
            stamp=sight.now,
            sequence=0,
            q=np.array(sight.q),
            v=np.zeros(self.robot_model.n),
            opening=sight.opening,
            finger_forces=(0.0, 0.0),
        )
        self.controller = GripperState(HeldObject(sight.holding) if sight.holding else None)

    def hold(self, duration: float, phase: str = "hold") -> None:
        """Wait; the gatekeeper holds the arm by itself, whatever `phase` is called here."""
        del phase
        time.sleep(duration)
        if self.client.now - self.state.stamp > SCENE_REQUEST_PERIOD:
            self.refresh()

    def execute(self, contract: Contract) -> Outcome:
        """Wait for the outcome of the contract that the gatekeeper has accepted; a person may interrupt it."""
        del contract
        asked = False
        try:
            while True:
                if self.interrupted() and not asked:
                    self.client.operate("abort")
                    asked = True
                ended = self.client.poll_outcome(SCENE_REQUEST_PERIOD)
                if ended is not None:
                    self.log.binding.update(ended.binding)
                    self.refresh()
                    return ended.outcome
                self.refresh()
        except ConnectionLostError as why:
            return Outcome(kind="stopped", reason=f"the gatekeeper is gone: {why}")


@dataclass(frozen=True, slots=True)
class RemoteGate:
    """Sends bytes, brings verdicts."""

    client: GatekeeperClient

    def check(self, data: bytes, *, names: SceneNames, principal: str, now: float, header: ContractHeader) -> Verdict:
        """The gatekeeper's word; the arm moves from the moment in which it accepts."""
        del names, principal, now
        answer = self.client.propose(data, header.scene_version)
        if isinstance(answer, RequestRefused):
            return Rejected(
                stage="authorization",
                pointer="",
                got=answer.reason,
                allowed="a contract that is fit to be judged",
                hint="not considered",
            )
        if answer.rejected is not None:
            return answer.rejected
        return Accepted(msgspec.json.decode(data, type=Contract))
