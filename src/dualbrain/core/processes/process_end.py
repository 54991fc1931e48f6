"""The end of a process: without the interpreter's clean-up, and at a deadline if its own clean-up takes too long."""

from __future__ import annotations

import logging
import os
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from threading import Thread
from typing import NoReturn


def end_process(code: int = 0) -> NoReturn:
    """End this process with the exit code `code`; what it has printed and logged is written first.

    The interpreter would free every module, which takes a second on a busy machine, and wait for threads. Functions of
    `atexit` are not called: the caller has closed all files and ended all child processes that must not remain.
    """
    logging.shutdown()
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError, ValueError, AttributeError):  # it may be closed or absent
            stream.flush()
    os._exit(code)


class EndDeadline:
    """Ends this process `limit` [s] after `start`, even if its main thread hangs."""

    def __init__(self, limit: float, before_end: Callable[[], None], *, code: int) -> None:
        """Call `before_end` at the deadline, which must not wait, then end with the exit code `code`."""
        self._limit, self._before_end, self._code = limit, before_end, code
        self._started = False

    def start(self) -> None:
        """Start the time; later calls change nothing. May be called from any thread, also by a handler of a signal."""
        if not self._started:
            self._started = True
            Thread(target=self._wait, args=(time.monotonic() + self._limit,), name="end deadline", daemon=True).start()

    def _wait(self, deadline: float) -> None:
        while (left := deadline - time.monotonic()) > 0.0:
            time.sleep(left)
        try:
            self._before_end()
        finally:
            os._exit(self._code)
