"""The parent's side of a process in another virtual environment, which carries out one unit after another.

The process sends one message when it is ready, the versions of its packages, and answers every request with one message
(`pipe_protocol`).
"""

from __future__ import annotations

import os
import subprocess
import tempfile
from pathlib import Path
from typing import Any

from experiments.robots.robosuite.pipe_protocol import PipeError, receive, send
from experiments.robots.robosuite.suite_process import SINGLE_THREAD_ENV, STDERR_TAIL_CHARS

ROOT = Path(__file__).resolve().parents[2]
UNIT_TIMEOUT_S = 900.0
"""Time limit of a unit on a busy machine [s]."""


class WorkerProcess:
    """A process of the software `title`; `versions` are those of its packages."""

    def __init__(self, title: str, python: Path, module: str, *arguments: str) -> None:
        """Run `python -m module *arguments` from the root of the repository."""
        self._title = title
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115  (lives as long as the process)
        self._process = subprocess.Popen(
            [str(python), "-m", module, *arguments],
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
        """The row of one unit; raises `PipeError` if the process has ended or does not answer in time."""
        send(self._request_pipe, parameters)
        return {**self._receive(), "versions": self.versions}

    def close(self) -> None:
        """End the process."""
        self._process.kill()
        self._process.wait()
        for stream in (self._process.stdin, self._process.stdout, self._errors):
            if stream is not None:
                stream.close()

    def _receive(self) -> dict[str, Any]:
        try:
            answer = receive(self._reply_pipe, UNIT_TIMEOUT_S)
        except PipeError as why:
            self._errors.seek(0)
            tail = self._errors.read().decode("utf-8", "replace")[-STDERR_TAIL_CHARS:].strip()
            self.close()
            raise PipeError(f"{why}; end of the stderr of {self._title}: {tail or 'empty'}") from None
        assert isinstance(answer, dict)
        return answer


def serve(versions: dict[str, str], run: Any) -> None:
    """The other side: answer requests with `run(parameters)` until the input ends.

    Output of libraries goes to stderr.
    """
    answers = os.dup(1)
    os.dup2(2, 1)
    send(answers, versions)
    while True:
        try:
            request = receive(0)
        except PipeError:
            return
        assert isinstance(request, dict)
        send(answers, run(request))
