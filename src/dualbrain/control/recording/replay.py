"""Replay: every control computed again from the recorded inputs, compared bit for bit.

Playing back recorded controls would prove nothing. Here a fresh filter gets the recorded calls and states in order
and must arrive at the same u, δ and h, to the last bit.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from dualbrain.control.recording.channels import EpisodeInfo, FilterCall, Ticks, read_recording, recording_state
from dualbrain.control.recording.trace import columns
from dualbrain.errors import ConfigurationError
from dualbrain.robots.interface import RobotState
from dualbrain.robots.loader import load_robot
from dualbrain.robots.model import RobotModel
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.safety.cbf.obstacles import Contact, Obstacle
from dualbrain.safety.cbf.result import FilterResult
from dualbrain.safety.cbf.rows import ConstraintRow
from dualbrain.safety.supervisor.controller import BRAKING, STANDSTILL, UNSCALED
from dualbrain.safety.supervisor.intervention import with_supervisor_control

Array = NDArray[np.float64]

COMPARED_COLUMNS = ("u", "delta", "h_min", "status")


@dataclass(slots=True, kw_only=True)
class ReplayResult:
    """What a replay found: ticks compared, ticks that differ (index of the first), and whether the file is whole."""

    ticks: int = 0
    differing: int = 0
    first: int | None = None
    complete: bool = True
    problem: str = ""
    instruction: str = ""
    worst: dict[str, float] = field(default_factory=dict)

    @property
    def identical(self) -> bool:
        """Whether every recorded control was reached again, bit for bit."""
        return self.ticks > 0 and self.differing == 0


def replay(path: Path) -> ReplayResult:
    """Replay the recording at `path`; raises `InvalidSetup` when it is none."""
    result = ReplayResult()
    machine: _ReplayFilter | None = None
    for message in read_recording(path):
        match message:
            case EpisodeInfo(_, data):
                machine = _ReplayFilter(data)
                result.instruction = str(data.get("instruction", ""))
            case FilterCall(_, name, arguments) if machine:
                machine.apply_call(name, arguments)
            case Ticks() if machine:
                for row in message.rows():
                    machine.compare(row, result)
            case _:
                pass
    if machine is None:
        raise ConfigurationError(
            "recording", got="no /episode message", allowed="a file written by dualbrain", fix=str(path)
        )
    state = recording_state(path)
    result.complete, result.problem = state.complete, state.problem
    return result


class _ReplayFilter:
    """A fresh filter that is fed what was recorded."""

    def __init__(self, data: Mapping[str, Any]) -> None:
        """`data` is the /episode message: robot and guard, and what a site file changed."""
        robot_model = msgspec.convert(data["body"], RobotModel) if "body" in data else load_robot(str(data["robot"]))
        standing = msgspec.convert(data.get("standing", ()), tuple[Obstacle, ...])
        self._filter, self._guard = SafetyFilter(robot_model, obstacles=standing), bool(data["guard"])
        self._columns = columns(robot_model.n, robot_model.nq)

    def apply_call(self, name: str, arguments: dict[str, Any]) -> None:
        """Repeat one call that changes the filter's tables."""
        match name:
            case "observe":
                self._filter.observe(msgspec.convert(arguments["obstacles"], tuple[Obstacle, ...]), arguments["stamp"])
            case "permit":
                self._filter.permit(msgspec.convert(arguments["permits"], tuple[Contact, ...]))
            case "attach":
                self._filter.attach(np.asarray(arguments["spheres"]), arguments["error"])
            case "detach":
                self._filter.detach()
            case "constrain":
                self._filter.constrain(msgspec.convert(arguments["rows"], tuple[ConstraintRow, ...]))
            case _:
                raise ConfigurationError(
                    "recorded call", got=name, allowed="observe, permit, attach, detach, constrain"
                )

    def _recompute(self, state: RobotState, part: dict[str, Array], now: float, touched: float) -> FilterResult | None:
        """The control as the supervisor let it be written; None where braking stood in for a broken filter."""
        u_nom = part["u_nom"]
        wish = u_nom if touched == UNSCALED else max(0.0, touched) * u_nom
        got = self._filter.filter(state, wish, now)
        if not self._guard:
            got = got.unfiltered()
        if touched == BRAKING:
            self._filter.reset(part["u"])
            return None
        if touched == STANDSTILL:
            self._filter.reset(0.0)
            return with_supervisor_control(got, u_nom, np.zeros_like(got.u))
        return got if touched == UNSCALED else with_supervisor_control(got, u_nom, got.u)

    def compare(self, row: Array, result: ReplayResult) -> None:
        """Compute one tick again and note how it differs from the recorded one."""
        part = {name: row[where] for name, where in self._columns.items()}
        forces = (float(part["forces"][0]), float(part["forces"][1]))
        state = RobotState(
            stamp=float(part["stamp"][0]),
            sequence=int(part["sequence"][0]),
            q=part["q"],
            v=part["v"],
            opening=float(part["opening"][0]),
            finger_forces=forces,
            drive_enabled=bool(part["drive"][0]),
        )
        touched = float(part["touched"][0])
        got = self._recompute(state, part, float(part["t"][0]), touched)
        if got is None:
            result.ticks += 1
            return
        again = {"u": got.u, "delta": got.delta, "h_min": got.h_min, "status": float(got.status)}
        same = all(np.array_equal(part[name], np.atleast_1d(again[name]), equal_nan=True) for name in COMPARED_COLUMNS)
        if not same:
            result.differing += 1
            result.first = result.ticks if result.first is None else result.first
            for name in COMPARED_COLUMNS:
                away = float(np.max(np.abs(part[name] - again[name])))
                result.worst[name] = max(result.worst.get(name, 0.0), away)
        result.ticks += 1
