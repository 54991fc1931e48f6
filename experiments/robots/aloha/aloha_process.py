"""The parent's side of gym-aloha: starts its process, which carries out one episode after another."""

from __future__ import annotations

import json
import os
import subprocess
import tempfile
from pathlib import Path
from typing import Any

from dualbrain.errors import DualbrainError
from experiments.robots.aloha.virtual_environment import ENVIRONMENT

ROOT = Path(__file__).resolve().parents[3]
PROCESS_ENV = {
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MUJOCO_GL": "disable",
    "PYTHONWARNINGS": "ignore",
    "PYTHONPATH": str(ROOT),
}
STDERR_TAIL_CHARS = 600
"""Characters of stderr in the message about a process that has ended."""


class AlohaProcess:
    """gym-aloha in its own environment and process."""

    def __init__(self) -> None:
        """Start the process; raises `MissingDependencyError` without its environment."""
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115  (lives as long as the process, see close)
        self._process = subprocess.Popen(
            [str(ENVIRONMENT.interpreter()), "-m", "experiments.robots.aloha.worker"],
            cwd=ROOT,
            env=os.environ | PROCESS_ENV,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._errors,
            text=True,
        )

    def run(self, parameters: dict[str, Any]) -> dict[str, Any]:
        """The row of one episode; raises `DualbrainError` if the process has ended."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        try:
            self._process.stdin.write(json.dumps(parameters) + "\n")
            self._process.stdin.flush()
            answer = self._process.stdout.readline()
        except BrokenPipeError:
            answer = ""
        if not answer:
            self._errors.seek(0)
            tail = self._errors.read().decode("utf-8", "replace")[-STDERR_TAIL_CHARS:].strip()
            raise DualbrainError(f"The process of gym-aloha has ended; end of its stderr: {tail or 'empty'}")
        return json.loads(answer)

    def close(self) -> None:
        """End the process."""
        self._process.kill()
        self._process.wait()
        for stream in (self._process.stdin, self._process.stdout, self._errors):
            if stream is not None:
                stream.close()
