"""The interface between the episode loop and a robot: in this process or behind a gatekeeper."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

from dualbrain.contracts.contract import Contract, ContractHeader
from dualbrain.contracts.scene_names import SceneNames
from dualbrain.contracts.verdict import Verdict
from dualbrain.control.recording.flight_log import FlightLog
from dualbrain.records import Outcome, Scene
from dualbrain.robots.interface import RobotState
from dualbrain.robots.model import RobotModel

Grants = Mapping[str, frozenset[str]]
"""Which principal may call which skills."""


class ContractGate(Protocol):
    """A gate that a proposal has to pass: the three-stage gate, a gatekeeper's gate, or the gate of a baseline."""

    def check(self, data: bytes, *, names: SceneNames, principal: str, now: float, header: ContractHeader) -> Verdict:
        """The verdict on `data`, the JSON text of a contract; invalid bytes are rejected and never raise."""
        ...


class Executor(Protocol):
    """Executes accepted contracts on one robot and reports the robot's own verdict.

    Implementations: `ContractExecutor` (in this process) and `RemoteExecutor` (behind a gatekeeper).
    """

    @property
    def robot_model(self) -> RobotModel:
        """The robot, with the limits that hold at its site."""
        ...

    @property
    def scene(self) -> Scene:
        """The newest perceived scene."""
        ...

    @property
    def state(self) -> RobotState:
        """The newest joint state; `state.stamp` is the executor's time [s]."""
        ...

    @property
    def held_object(self) -> str | None:
        """The name of the object in the gripper, None if the gripper is empty."""
        ...

    @property
    def log(self) -> FlightLog:
        """Events, binding barriers and the trace of the run."""
        ...

    def gate(self, grants: Grants) -> ContractGate:
        """The gate in front of this executor; `grants` defines which principal may call which skills."""
        ...

    def hold(self, duration: float, phase: str = "hold") -> None:
        """Hold position for `duration` [s]; the filter may still give way to a moving obstacle."""
        ...

    def execute(self, contract: Contract) -> Outcome:
        """Execute an accepted contract to its end; the outcome is the robot's own verdict, never simulator truth."""
        ...

    def interrupted(self) -> bool:
        """Whether a person wants the robot to stop."""
        ...
