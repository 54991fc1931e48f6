"""Handling of signals while a robot moves.

The first Ctrl-C or SIGTERM stops it in a controlled way, the second exits; a gatekeeper that a person started survives
a closed terminal.
"""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

SIGNALS = (signal.SIGINT, signal.SIGTERM)


@contextmanager
def interrupt_handler(interrupt: Callable[[], None]) -> Iterator[None]:
    """While the body runs, the first of `SIGNALS` calls `interrupt`; every later one raises `KeyboardInterrupt`."""

    def first(number: int, frame: FrameType | None) -> None:
        del number, frame
        for each in SIGNALS:
            signal.signal(each, signal.default_int_handler)
        interrupt()

    previous = {each: signal.signal(each, first) for each in SIGNALS}
    try:
        yield
    finally:
        for each, handler in previous.items():
            signal.signal(each, handler)


def survive_closed_terminal() -> None:
    """Ignore SIGHUP and discard all further output once it has arrived, because a closed terminal refuses it.

    A process for which `nohup` already ignores SIGHUP keeps its output.
    """

    def discard_output(number: int, frame: FrameType | None) -> None:
        del number, frame
        signal.signal(signal.SIGHUP, signal.SIG_IGN)
        null = os.open(os.devnull, os.O_RDWR)
        for stream in (sys.stdout, sys.stderr):
            os.dup2(null, stream.fileno())
        os.close(null)

    if signal.getsignal(signal.SIGHUP) is signal.SIG_DFL:
        signal.signal(signal.SIGHUP, discard_output)
