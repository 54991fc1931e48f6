"""The parent's side of the suite: starts its process, which answers one request after another."""

from __future__ import annotations

import os
import subprocess
import tempfile
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from dualbrain.core.geometry.shapes import Pose
from experiments.robots.robosuite.pipe_protocol import PipeError, receive, send
from experiments.robots.robosuite.virtual_environment import ENVIRONMENT

Array = NDArray[np.float64]

ROOT = Path(__file__).resolve().parents[3]
SINGLE_THREAD_ENV = {
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MUJOCO_GL": "disable",
    "PYTHONWARNINGS": "ignore",
}
RESPONSE_TIMEOUT_S = 300.0
"""Time limit of an answer, for a busy machine [s]."""
STDERR_TAIL_CHARS = 600
"""Characters of stderr in the message about a suite process that has ended."""


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
        python = ENVIRONMENT.interpreter()
        environment = {key: value for key, value in os.environ.items() if key not in ("PYTHONPATH", "PYTHONHOME")}
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115  (lives as long as the process, see close)
        self._process = subprocess.Popen(
            [str(python), "-m", "experiments.robots.robosuite.worker"],
            cwd=ROOT,
            env=environment | SINGLE_THREAD_ENV | {"PYTHONPATH": str(ROOT)},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._errors,
            bufsize=0,
        )
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._request_pipe, self._reply_pipe = self._process.stdin.fileno(), self._process.stdout.fileno()
        self._cubes: list[str] = []
        self.versions: dict[str, str] = self._receive_dict()["versions"]

    def open(self, task: str, seed: int) -> TaskSetup:
        """Set up `task` with `seed`."""
        send(self._request_pipe, {"do": "open", "task": task, "seed": seed})
        opened = msgspec.convert(self._receive_dict(), TaskSetup)
        self._cubes = opened.cubes
        return opened

    def grip_sites(self, postures: Array) -> Array:
        """The suite's grip site at `postures` (k, 7): position and rotation matrix, (k, 12), in the base frame."""
        send(self._request_pipe, {"do": "sites", "postures": postures.tolist()})
        return np.array(self._receive_dict()["sites"])

    def step(self, u: Array, closed: bool) -> State:
        """Apply u (7,) [rad/s] for one period, with the fingers closing or opening; returns the state after it."""
        send(self._request_pipe, np.r_[u, 1.0 if closed else -1.0])
        answer = self._receive()
        assert not isinstance(answer, dict)
        return self.parse_state(answer)

    def limit_report(self) -> dict[str, Any]:
        """The success, breaches and torque saturation since the task was opened."""
        send(self._request_pipe, {"do": "account"})
        return self._receive_dict()

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
        self._process.kill()
        self._process.wait()
        for stream in (self._process.stdin, self._process.stdout, self._errors):
            if stream is not None:
                stream.close()

    def _receive_dict(self) -> dict[str, Any]:
        answer = self._receive()
        assert isinstance(answer, dict)
        return answer

    def _receive(self) -> dict[str, Any] | Array:
        try:
            return receive(self._reply_pipe, RESPONSE_TIMEOUT_S)
        except PipeError as why:
            self._errors.seek(0)
            tail = self._errors.read().decode("utf-8", "replace")[-STDERR_TAIL_CHARS:].strip()
            raise PipeError(f"{why}; end of the suite's stderr: {tail or 'empty'}") from None
