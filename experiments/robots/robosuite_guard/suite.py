"""The parent's side of robosuite's process: starts it, and has it run one episode after another."""

from __future__ import annotations

import os
import subprocess
import tempfile
from typing import Any

from experiments.robots.robosuite.pipe_protocol import PipeError, receive, send
from experiments.robots.robosuite.suite_process import SINGLE_THREAD_ENV, STDERR_TAIL_CHARS
from experiments.robots.robosuite_guard.virtual_environment import ROOT, create

EPISODE_TIMEOUT_S = 900.0
"""Time limit of an episode on a busy machine [s]."""


class GuardedSuite:
    """robosuite with dualbrain in its own process."""

    def __init__(self) -> None:
        """Start the process; its environment is created if it is missing."""
        python = create()
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115  (lives as long as the process)
        self._process = subprocess.Popen(
            [str(python), "-m", "experiments.robots.robosuite_guard.worker"],
            cwd=ROOT,
            env={**os.environ, **SINGLE_THREAD_ENV, "PYTHONPATH": str(ROOT)},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._errors,
            bufsize=0,
        )
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._request_pipe, self._reply_pipe = self._process.stdin.fileno(), self._process.stdout.fileno()
        self.versions = self._receive()

    def run(self, parameters: dict[str, Any]) -> dict[str, Any]:
        """The row of one episode."""
        send(self._request_pipe, parameters)
        return {**self._receive(), "versions": self.versions}

    def _receive(self) -> dict[str, Any]:
        try:
            answer = receive(self._reply_pipe, EPISODE_TIMEOUT_S)
        except PipeError as why:
            self._errors.seek(0)
            tail = self._errors.read().decode("utf-8", "replace")[-STDERR_TAIL_CHARS:].strip()
            raise PipeError(f"{why}; end of robosuite's stderr: {tail or 'empty'}") from None
        assert isinstance(answer, dict)
        return answer
