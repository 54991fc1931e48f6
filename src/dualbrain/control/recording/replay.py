"""Replay: recomputes every control from the recorded inputs and compares it with the recorded control bit for bit.

A fresh filter gets the recorded calls and states in their order and must compute the same u, δ, h and status, to the
last bit.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from math import isnan
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from dualbrain.control.margin_causes import MarginMonitor
from dualbrain.control.recording.channels import (
    EpisodeInfo,
    FilterCall,
    Ticks,
    damaged_recording,
    read_recording,
    recording_state,
)
from dualbrain.control.recording.recorded_robot import recorded_robot
from dualbrain.control.recording.trace import columns
from dualbrain.errors import ConfigurationError
from dualbrain.records import MarginShortfall
from dualbrain.robots.interface import RobotState
from dualbrain.safety.cbf.config import FilterConfig
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.safety.cbf.obstacles import Contact, Obstacle
from dualbrain.safety.cbf.result import FilterResult
from dualbrain.safety.cbf.rows import ConstraintRow
from dualbrain.safety.supervisor.controller import BRAKING, STANDSTILL, UNSCALED
from dualbrain.safety.supervisor.intervention import with_supervisor_control

Array = NDArray[np.float64]

COMPARED_COLUMNS = ("u", "delta", "h_min", "status")
"""Columns of the trace that a replay recomputes and compares."""


@dataclass(slots=True, kw_only=True)
class ReplayResult:
    """Result of a replay.

    `ticks` were compared and `differing` of them differ, beginning at index `first`; `worst` is the largest difference
    by column. `margin_shortfalls` are the recomputed intervals with h < 0. `complete` is False if messages are missing
    in the file; `problem` is the error that ended the recording.
    """

    ticks: int = 0
    differing: int = 0
    first: int | None = None
    complete: bool = True
    problem: str = ""
    instruction: str = ""
    worst: dict[str, float] = field(default_factory=dict)
    margin_shortfalls: tuple[MarginShortfall, ...] = ()

    @property
    def identical(self) -> bool:
        """Whether every recorded control was recomputed bit for bit."""
        return self.ticks > 0 and self.differing == 0


def replay(path: Path) -> ReplayResult:
    """Replay the recording at `path`.

    Raises `ConfigurationError` if the file is not a recording or is damaged.
    """
    result = ReplayResult()
    try:
        found = _replay_messages(path, result)
    except (
        msgspec.ValidationError,
        KeyError,
        TypeError,
        ValueError,
        IndexError,
        ArithmeticError,
        MemoryError,
    ) as error:
        raise damaged_recording(path, error) from error
    if found is None:
        raise ConfigurationError.stating(
            f"The file {path} has no /episode message.", fix="Name a recording that dualbrain wrote."
        )
    result.margin_shortfalls = found.monitor.shortfalls
    state = recording_state(path)
    result.complete, result.problem = state.complete, state.problem
    return result


def _replay_messages(path: Path, result: ReplayResult) -> _ReplayFilter | None:
    """Replay every message into `result`; returns the filter, None if there was no /episode message."""
    replay_filter: _ReplayFilter | None = None
    for message in read_recording(path):
        match message:
            case EpisodeInfo(_, data):
                replay_filter = _ReplayFilter(data)
                result.instruction = str(data.get("instruction", ""))
            case FilterCall(_, name, arguments) if replay_filter:
                replay_filter.apply_call(name, arguments)
            case Ticks() if replay_filter:
                for row in message.rows():
                    replay_filter.compare(row, result)
            case _:
                pass
    return replay_filter


def measured_or_none(values: Array) -> Array | None:
    """A recorded reading; None if the robot did not measure it."""
    return None if np.isnan(values).all() else values


class _ReplayFilter:
    """A fresh filter that gets the recorded calls and states."""

    def __init__(self, data: Mapping[str, Any]) -> None:
        """Make the filter of the /episode message `data`: robot, guard, and the changes that a site file made."""
        robot_model = recorded_robot(data)
        obstacles = msgspec.convert(data.get("standing", ()), tuple[Obstacle, ...])
        config = FilterConfig(cartesian_speed=data.get("cartesian_speed"))
        self._filter, self._guard = SafetyFilter(robot_model, config, obstacles=obstacles), bool(data["guard"])
        self._columns = columns(robot_model.n, robot_model.nq)
        self.monitor = MarginMonitor(self._filter)

    def apply_call(self, name: str, arguments: dict[str, Any]) -> None:
        """Repeat one recorded call that changes the filter's tables."""
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
            case "reset":
                u_prev = np.asarray(arguments["u_prev"], np.float64)
                change = arguments.get("u_change", np.zeros_like(u_prev))  # recorded since 0.3
                self._filter.reset(u_prev, np.asarray(change, np.float64))
            case _:
                raise ConfigurationError(
                    "recorded call", got=name, allowed="observe, permit, attach, detach, constrain, reset"
                )

    def _recompute(self, state: RobotState, part: dict[str, Array], now: float, scale: float) -> FilterResult | None:
        """The result with the control that the supervisor wrote; None where braking replaced a failed filter."""
        u_nom = part["u_nom"]
        scaled = u_nom if scale == UNSCALED else max(0.0, scale) * u_nom + 0.0
        result = self._filter.filter(state, scaled, now)
        if not self._guard:
            result = result.unfiltered()
        written = {BRAKING: part["u"], STANDSTILL: np.zeros_like(result.u)}.get(scale, result.u)
        if scale in (BRAKING, STANDSTILL):
            self._filter.reset(written)
        if scale != UNSCALED:
            result = with_supervisor_control(result, u_nom, written)
        if self._guard:
            self.monitor.update(now, state, result)
        return None if scale == BRAKING else result

    def compare(self, row: Array, result: ReplayResult) -> None:
        """Recompute the tick of one recorded row (width,) and add its differences to `result`."""
        if len(row) != (width := self._columns["phase"].stop):
            raise ConfigurationError("width of the recorded ticks", got=len(row), allowed=str(width))
        part = {name: row[where] for name, where in self._columns.items()}
        forces = (float(part["forces"][0]), float(part["forces"][1]))
        state = RobotState(
            stamp=float(part["stamp"][0]),
            sequence=int(part["sequence"][0]),
            q=part["q"],
            v=part["v"],
            opening=None if isnan(part["opening"][0]) else float(part["opening"][0]),
            finger_forces=forces,
            drive_enabled=bool(part["drive"][0]),
            torques=measured_or_none(part["torques"]),
            wrench=measured_or_none(part["wrench"]),
        )
        got = self._recompute(state, part, float(part["t"][0]), float(part["touched"][0]))
        if got is None:
            result.ticks += 1
            return
        values = {"u": got.u, "delta": got.delta, "h_min": got.h_min, "status": float(got.status)}
        same = all(np.array_equal(part[name], np.atleast_1d(values[name]), equal_nan=True) for name in COMPARED_COLUMNS)
        if not same:
            result.differing += 1
            result.first = result.ticks if result.first is None else result.first
            for name in COMPARED_COLUMNS:
                difference = float(np.max(np.abs(part[name] - values[name])))
                result.worst[name] = max(result.worst.get(name, 0.0), difference)
        result.ticks += 1
