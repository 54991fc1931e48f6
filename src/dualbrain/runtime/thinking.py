"""How time passes while the planner thinks: the control loop never waits for it.

In lockstep the arm stands still for a fixed simulated time, so that results do not depend on the machine; paced, it
stands still for as long as the planner really takes.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, wait
from dataclasses import dataclass
from threading import Thread
from typing import Protocol, TypeVar

from dualbrain.runtime.gatekeeper.remote_layer import RemoteLayer
from dualbrain.runtime.local_layer import LocalLayer

T = TypeVar("T")

PLANNING_TIME = 2.0
"""Simulated seconds that a decision takes in lockstep (design 8)."""


class Clock(Protocol):
    """A monotonic clock [s]."""

    def __call__(self) -> float:
        """Seconds since some fixed moment."""
        ...


@dataclass(frozen=True, slots=True)
class Thinking:
    """`measured` False: lockstep. The clock only measures; it steers nothing."""

    clock: Clock
    measured: bool = False
    planning_time: float = PLANNING_TIME

    def wait_for(self, layer: LocalLayer | RemoteLayer, ask: Callable[[], T]) -> T | None:
        """The answer of `ask`, called on a thread of its own while the arm stands still; None when a person interrupts.

        Nobody waits for a thread that was left behind by an interruption: it ends with the process.
        """
        answer: Future[T] = Future()
        Thread(target=_fulfil, args=(answer, ask), name="planner", daemon=True).start()
        if not self.measured:
            layer.hold(self.planning_time, "planning")
        while not (answer.done() or layer.interrupted()):
            if self.measured:
                layer.hold(0.02, "planning")
            else:
                wait((answer,), timeout=0.1)
        return None if layer.interrupted() else answer.result()

    def timed(self, do: Callable[[], T]) -> tuple[T, float]:
        """The result of `do` and how long it took [s]."""
        start = self.clock()
        return do(), self.clock() - start


def _fulfil(answer: Future[T], ask: Callable[[], T]) -> None:
    """Put into `answer` what `ask` returns or raises."""
    try:
        answer.set_result(ask())
    except BaseException as error:  # it is raised where the answer is read
        answer.set_exception(error)
