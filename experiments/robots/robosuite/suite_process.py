"""The parent's side of the suite: starts its process, which answers one request after another."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from dualbrain.core.geometry.shapes import Pose
from experiments.engine.piped_process import PipedProcess
from experiments.robots.robosuite.virtual_environment import ENVIRONMENT

Array = NDArray[np.float64]

RESPONSE_TIMEOUT_S = 300.0
"""Time limit of an answer, for a busy machine [s]."""


class State(msgspec.Struct, frozen=True, eq=False, kw_only=True):
    """The state after a step: time [s], q (7,) [rad], v (7,) [rad/s], finger opening [m], success check, cubes."""

    time: float
    q: Array
    v: Array
    opening: float
    success: bool
    cubes: dict[str, Pose]


class SuiteObject(msgspec.Struct, frozen=True, kw_only=True):
    """An object in the arm's base frame; `size`: half extents, radius and half length, or unused [m]."""

    name: str
    solid: str
    size: tuple[float, float, float]
    position: tuple[float, float, float]
    quaternion: tuple[float, float, float, float]


class TaskSetup(msgspec.Struct, frozen=True, eq=False, kw_only=True):
    """A task that the suite has set up: period [s], names of the cubes, objects, torque limits, first state."""

    period: float
    cubes: list[str]
    things: list[SuiteObject]
    torques: list[float]
    state: list[float]


class SuiteProcess:
    """robosuite in its own process."""

    def __init__(self) -> None:
        """Start the process; raises `MissingDependencyError` without its environment."""
        self._process = PipedProcess("the suite", ENVIRONMENT.interpreter(), "experiments.robots.robosuite.worker")
        self._cubes: list[str] = []
        self.versions: dict[str, str] = self._process.receive_dict(RESPONSE_TIMEOUT_S)["versions"]

    def open(self, task: str, seed: int) -> TaskSetup:
        """Set up `task` with `seed`."""
        self._process.send({"do": "open", "task": task, "seed": seed})
        opened = msgspec.convert(self._process.receive_dict(RESPONSE_TIMEOUT_S), TaskSetup)
        self._cubes = opened.cubes
        return opened

    def grip_sites(self, postures: Array) -> Array:
        """The suite's grip site at `postures` (k, 7): position and rotation matrix, (k, 12), in the base frame."""
        self._process.send({"do": "sites", "postures": postures.tolist()})
        return np.array(self._process.receive_dict(RESPONSE_TIMEOUT_S)["sites"])

    def step(self, u: Array, closed: bool) -> State:
        """Apply u (7,) [rad/s] for one period, with the fingers closing or opening; returns the state after it."""
        self._process.send(np.r_[u, 1.0 if closed else -1.0])
        answer = self._process.receive(RESPONSE_TIMEOUT_S)
        assert not isinstance(answer, dict)
        return self.parse_state(answer)

    def limit_report(self) -> dict[str, Any]:
        """The success, breaches and torque saturation since the task was opened."""
        self._process.send({"do": "account"})
        return self._process.receive_dict(RESPONSE_TIMEOUT_S)

    def parse_state(self, numbers: Array | list[float]) -> State:
        """The state from the numbers of a step."""
        numbers = np.asarray(numbers, float)
        q, v, rest = numbers[1:8], numbers[8:15], numbers[17:].reshape(-1, 7).tolist()
        cubes = {
            name: Pose((row[0], row[1], row[2]), (row[3], row[4], row[5], row[6]))
            for name, row in zip(self._cubes, rest, strict=True)
        }
        return State(
            time=float(numbers[0]), q=q, v=v, opening=float(numbers[15]), success=bool(numbers[16]), cubes=cubes
        )

    def close(self) -> None:
        """End the process."""
        self._process.close()
