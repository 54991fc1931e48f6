"""The parent's side of a process in another virtual environment, which answers messages on its standard input.

`pipe_protocol` is the form of the messages. The last characters of the standard error are in the message of a failure.
"""

from __future__ import annotations

import os
import subprocess
import tempfile
from pathlib import Path
from typing import Any

from experiments.engine.pipe_protocol import Array, PipeError, receive, send

ROOT = Path(__file__).resolve().parents[2]
SINGLE_THREAD_ENV = {
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MUJOCO_GL": "disable",
    "PYTHONWARNINGS": "ignore",
}
OTHER_INTERPRETER = ("PYTHONPATH", "PYTHONHOME")
"""Variables by which the interpreter of this program would change that of the process."""
STDERR_TAIL_CHARS = 600
"""Characters of stderr in the message about a process that has ended."""


class PipedProcess:
    """A process of the software `title`, with one thread for each numerical library."""

    def __init__(self, title: str, python: Path, module: str, *arguments: str) -> None:
        """Run `python -m module *arguments` from the root of the repository."""
        self._title, self._is_closed = title, False
        inherited = {key: value for key, value in os.environ.items() if key not in OTHER_INTERPRETER}
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115  (lives as long as the process, see close)
        self._process = subprocess.Popen(
            [str(python), "-m", module, *arguments],
            cwd=ROOT,
            env=inherited | SINGLE_THREAD_ENV | {"PYTHONPATH": str(ROOT)},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._errors,
            bufsize=0,
        )
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._request_pipe, self._reply_pipe = self._process.stdin.fileno(), self._process.stdout.fileno()

    def send(self, message: dict[str, Any] | Array) -> None:
        """Send a message; raises `PipeError` if the process has ended."""
        self._check_open()
        try:
            send(self._request_pipe, message)
        except OSError as why:
            raise self._failure(str(why)) from None

    def receive(self, timeout: float) -> dict[str, Any] | Array:
        """The next message; raises `PipeError` if none comes within `timeout` [s], or if the process has ended."""
        self._check_open()
        try:
            return receive(self._reply_pipe, timeout)
        except PipeError as why:
            raise self._failure(str(why)) from None

    def receive_dict(self, timeout: float) -> dict[str, Any]:
        """As `receive`, for a message that is no array."""
        answer = self.receive(timeout)
        assert isinstance(answer, dict)
        return answer

    def close(self) -> None:
        """End the process."""
        self._is_closed = True
        self._process.kill()
        self._process.wait()
        for stream in (self._process.stdin, self._process.stdout, self._errors):
            if stream is not None:
                stream.close()

    def _check_open(self) -> None:
        """Refuse a closed process, whose file descriptors may belong to other files by now."""
        if self._is_closed:
            raise PipeError(f"The process of {self._title} has been ended.")

    def _failure(self, why: str) -> PipeError:
        """The error that states `why`, with the end of stderr; the process is ended."""
        self._errors.seek(0)
        tail = self._errors.read().decode("utf-8", "replace")[-STDERR_TAIL_CHARS:].strip()
        self.close()
        return PipeError(f"{why}; end of the stderr of {self._title}: {tail or 'empty'}")
