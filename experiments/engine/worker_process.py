"""A process in another virtual environment that carries out one unit after another.

The process first sends the versions of its packages, and then answers every request with one message.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

from experiments.engine.pipe_protocol import PipeError, receive, send
from experiments.engine.piped_process import PipedProcess

UNIT_TIMEOUT_S = 900.0
"""Time limit of a unit on a busy machine [s]."""


class WorkerProcess:
    """The parent's side; `versions` are those of the packages of the process."""

    def __init__(self, title: str, python: Path, module: str, *arguments: str) -> None:
        """Run `python -m module *arguments` of the software `title`, which calls `serve`; raises `PipeError`."""
        self._process = PipedProcess(title, python, module, *arguments)
        self.versions = self._process.receive_dict(UNIT_TIMEOUT_S)

    def run(self, parameters: dict[str, Any]) -> dict[str, Any]:
        """The row of one unit; raises `PipeError` if the process has ended or does not answer in time."""
        self._process.send(parameters)
        return {**self._process.receive_dict(UNIT_TIMEOUT_S), "versions": self.versions}


def serve(versions: dict[str, str], run: Callable[[dict[str, Any]], dict[str, Any]]) -> None:
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
