"""The end of a process's standard error and a description of its exit status, to report why it ended."""

from __future__ import annotations

import os
import signal
from threading import Thread
from typing import IO

from dualbrain.planner.backends.key_redaction import KeyRedactor

MAX_TAIL_BYTES = 4096
"""Number of bytes of standard error that are kept, the last ones."""
MAX_REPORTED_CHARACTERS = 400
"""Number of characters that are reported, the last ones; they are stored in the records of a run."""
JOIN_TIMEOUT_S = 1.0
"""Time to wait for the remaining output of an ended process [s]."""


class StderrTail:
    """The end of the output of a process to `pipe`; a thread reads all output, so that the process never blocks."""

    def __init__(self, pipe: IO[bytes], *, secret: str = "") -> None:
        """Read until the process has ended; `secret` is never reported (`KeyRedactor`)."""
        self._pipe, self._redactor, self._tail = pipe, KeyRedactor(secret), b""
        self._kept_bytes = MAX_TAIL_BYTES + len(secret)
        self._thread = Thread(target=self._read, name="stderr reader", daemon=True)
        self._thread.start()

    def text(self) -> str:
        """The end of the output of an ended process in printable ASCII, with "|" between lines; "" without output."""
        self._thread.join(JOIN_TIMEOUT_S)
        lines = map(self._redactor.redact_text, self._tail.decode("utf-8", "replace").splitlines())
        text = " | ".join(filter(None, map(str.strip, lines)))
        if len(self._tail) == self._kept_bytes:  # the text may begin with the end of the secret
            text = text[self._kept_bytes - MAX_TAIL_BYTES :]
        return ascii(text)[1:-1][-MAX_REPORTED_CHARACTERS:]

    def close(self) -> None:
        """Close the pipe of an ended process."""
        self._thread.join(JOIN_TIMEOUT_S)
        if not self._thread.is_alive():
            self._pipe.close()

    def _read(self) -> None:
        while chunk := os.read(self._pipe.fileno(), MAX_TAIL_BYTES):
            self._tail = (self._tail + chunk)[-self._kept_bytes :]


def describe_exit(code: int) -> str:
    """The exit of a process by its return `code`: a signal (negative code) or an exit code."""
    if code >= 0:
        return f"exit code {code}"
    reason = f"signal {-code} ({signal.strsignal(-code) or 'unknown'})"
    return f"{reason}, possibly because the system ran out of memory" if code == -signal.SIGKILL else reason
