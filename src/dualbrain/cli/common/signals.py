"""Ctrl-C (or SIGTERM) while a robot moves: the first asks it to brake and to record, the second leaves at once."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

SIGNALS = (signal.SIGINT, signal.SIGTERM)


@contextmanager
def interrupt_handler(interrupt: Callable[[], None]) -> Iterator[None]:
    """The first of `SIGNALS` inside calls `interrupt`; from then on each raises `KeyboardInterrupt`."""

    def first(number: int, frame: FrameType | None) -> None:
        del number, frame
        for each in SIGNALS:
            signal.signal(each, signal.default_int_handler)
        interrupt()

    before = {each: signal.signal(each, first) for each in SIGNALS}
    try:
        yield
    finally:
        for each, usual in before.items():
            signal.signal(each, usual)
