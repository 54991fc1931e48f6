"""The parent's side of the suite: a process that lives as long as this object, asked one thing after another."""

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
from experiments.robots.robosuite.pipe_protocol import Broken, receive, send
from experiments.robots.robosuite.virtual_environment import python_in

Array = NDArray[np.float64]

ROOT = Path(__file__).resolve().parents[3]
ALONE = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MUJOCO_GL": "disable", "PYTHONWARNINGS": "ignore"}
PATIENCE = 300.0
"""How long an answer may take on a busy machine [s]."""
LAST_WORDS = 600
"""Characters of its stderr that are told when the suite's process has ended."""


class State(msgspec.Struct, frozen=True, eq=False):
    """What the suite shows after a step: time [s], q and v (7,), opening of a finger [m], its success check, cubes."""

    time: float
    q: Array
    v: Array
    opening: float
    success: bool
    cubes: dict[str, Pose]


class Thing(msgspec.Struct, frozen=True):
    """A shape that stands there: half extents, radius and half length, or nothing [m], in the arm's base frame."""

    name: str
    solid: str
    size: tuple[float, float, float]
    position: tuple[float, float, float]
    quaternion: tuple[float, float, float, float]


class Opened(msgspec.Struct, frozen=True, eq=False):
    """A task as the suite has set it up: period [s], names of its cubes, what stands there, the first state."""

    period: float
    cubes: list[str]
    things: list[Thing]
    torques: list[float]
    state: list[float]


class Suite:
    """robosuite in a process of its own."""

    def __init__(self) -> None:
        """Start it; raises `MissingPart` where its environment is not made."""
        python = python_in()
        own = {key: value for key, value in os.environ.items() if key not in ("PYTHONPATH", "PYTHONHOME")}
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115  (lives as long as the process, see close)
        self._process = subprocess.Popen(
            [str(python), "-m", "experiments.robots.robosuite.worker"], cwd=ROOT, env=own | ALONE | {"PYTHONPATH": str(ROOT)},
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self._errors, bufsize=0,
        )  # fmt: skip
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._ask, self._answer = self._process.stdin.fileno(), self._process.stdout.fileno()
        self._cubes: list[str] = []
        self.versions: dict[str, str] = self._words()["versions"]

    def open(self, task: str, seed: int) -> Opened:
        """Set `task` up afresh, as its seed says."""
        send(self._ask, {"do": "open", "task": task, "seed": seed})
        opened = msgspec.convert(self._words(), Opened)
        self._cubes = opened.cubes
        return opened

    def sites(self, postures: Array) -> Array:
        """The suite's grip site at `postures` (k, 7): position and rotation matrix, (k, 12), in the base frame."""
        send(self._ask, {"do": "sites", "postures": postures.tolist()})
        return np.array(self._words()["sites"])

    def step(self, u: Array, closed: bool) -> State:
        """Drive at u (7,) [rad/s] for one period, fingers closing or opening; the state after it."""
        send(self._ask, np.r_[u, 1.0 if closed else -1.0])
        answer = self._heard()
        assert not isinstance(answer, dict)
        return self.read(answer)

    def account(self) -> dict[str, Any]:
        """What the suite's process judged since the task was opened."""
        send(self._ask, {"do": "account"})
        return self._words()

    def read(self, numbers: Array | list[float]) -> State:
        """The state behind the numbers of a step."""
        numbers = np.asarray(numbers, float)
        q, v, rest = numbers[1:8], numbers[8:15], numbers[17:].reshape(-1, 7).tolist()
        cubes = {
            name: Pose((row[0], row[1], row[2]), (row[3], row[4], row[5], row[6]))
            for name, row in zip(self._cubes, rest, strict=True)
        }
        return State(float(numbers[0]), q, v, float(numbers[15]), bool(numbers[16]), cubes)

    def close(self) -> None:
        """End the process."""
        self._process.kill()
        self._process.wait()
        for stream in (self._process.stdin, self._process.stdout, self._errors):
            if stream is not None:
                stream.close()

    def _words(self) -> dict[str, Any]:
        answer = self._heard()
        assert isinstance(answer, dict)
        return answer

    def _heard(self) -> dict[str, Any] | Array:
        try:
            return receive(self._answer, PATIENCE)
        except Broken as why:
            self._errors.seek(0)
            said = self._errors.read().decode("utf-8", "replace")[-LAST_WORDS:].strip()
            raise Broken(f"{why}; the suite's last words: {said or 'none'}") from None
