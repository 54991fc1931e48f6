"""Handling of Ctrl-C and SIGTERM while a robot moves: the first stops it in a controlled way, the second exits."""

from __future__ import annotations

import signal
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
