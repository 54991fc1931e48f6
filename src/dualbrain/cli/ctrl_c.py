"""Ctrl-C while a robot moves: the first asks it to brake and to record, the second leaves at once."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType


@contextmanager
def ctrl_c(interrupt: Callable[[], None]) -> Iterator[None]:
    """The first Ctrl-C inside calls `interrupt`; from then on Ctrl-C raises `KeyboardInterrupt` again."""

    def first(number: int, frame: FrameType | None) -> None:
        del number, frame
        signal.signal(signal.SIGINT, signal.default_int_handler)
        interrupt()

    before = signal.signal(signal.SIGINT, first)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
