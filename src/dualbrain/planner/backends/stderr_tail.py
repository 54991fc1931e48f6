"""What a process said on standard error before it ended, and how it ended: why it did is mostly there."""

from __future__ import annotations

import os
import signal
from threading import Thread
from typing import IO

MAX_TAIL_BYTES = 4096
"""Bytes of standard error that are kept: the last ones."""
MAX_REPORTED_CHARACTERS = 400
"""Characters of them that are told, again the last: they stand in the records of a run."""
JOIN_TIMEOUT_S = 1.0
"""How long the rest of an ended process's words is waited for [s]."""


class StderrTail:
    """The end of what a process writes to `pipe`, which is read all the while, so that the process waits for nobody."""

    def __init__(self, pipe: IO[bytes], *, secret: str = "") -> None:
        """Read until the process has ended; `without` is a secret that is never told."""
        self._pipe, self._secret, self._tail = pipe, secret.encode(), b""
        self._thread = Thread(target=self._read, name="last words", daemon=True)
        self._thread.start()

    def text(self) -> str:
        """The last words of a process that has ended, in printable ASCII, "|" between lines; "" if there are none."""
        self._thread.join(JOIN_TIMEOUT_S)
        kept = self._tail.replace(self._secret, b"[key]") if self._secret else self._tail
        lines = (line.strip() for line in kept.decode("utf-8", "replace").splitlines())
        return ascii(" | ".join(filter(None, lines)))[1:-1][-MAX_REPORTED_CHARACTERS:]

    def close(self) -> None:
        """Let go of the pipe of a process that has ended."""
        self._thread.join(JOIN_TIMEOUT_S)
        if not self._thread.is_alive():
            self._pipe.close()

    def _read(self) -> None:
        while said := os.read(self._pipe.fileno(), MAX_TAIL_BYTES):
            self._tail = (self._tail + said)[-MAX_TAIL_BYTES:]


def describe_exit(code: int) -> str:
    """How a process ended, by its return code: what POSIX calls a signal, or what it said itself."""
    if code >= 0:
        return f"exit code {code}"
    by = f"signal {-code} ({signal.strsignal(-code) or 'unknown'})"
    return f"{by}, as a system that is short of memory ends a process" if code == -signal.SIGKILL else by
