"""Cooperative time slicing for expensive computations of skills.

Skills compute before they move: inverse kinematics, clearance prediction, path planning. Such a computation can take up
to a second, but a control tick takes one millisecond. A computation is therefore a generator that yields None after
every *step* of about 50 µs of work, such as one posture of the arm, and returns its result. A routine passes the yields
on (`yield from`). After `steps_per_tick` steps the tick ends, and the robot rests until the next tick.

Work is counted in steps, not in time. The result is therefore independent of the machine, equal in lockstep and in real
time, and reproducible when a contract is replayed.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable
from typing import Generic, TypeVar

import numpy as np

T = TypeVar("T")
SlicedComputation = Generator[None, None, T]
"""A computation that yields after every step."""
SlicedIterator = Generator[T | None, None, None]
"""An iterator over results that yields None after every step."""

STEPS_PER_SECOND = 5000.0
"""Steps per second: five in a tick of 1 ms, which take about a quarter of the tick."""
SUFFICIENT_CLEARANCE = 0.004
"""Clearance [m] beyond the margins from which a path counts as clear."""


def steps_per_tick(period: float) -> int:
    """Number of steps in one control tick of `period` [s]."""
    return max(1, round(STEPS_PER_SECOND * period))


def run_to_completion(computation: SlicedComputation[T]) -> T:
    """The result of a computation, without interruption, for callers outside the control loop."""
    while True:
        try:
            next(computation)
        except StopIteration as over:
            return over.value


def collect(computation: SlicedIterator[T]) -> list[T]:
    """All results of an iterator, without interruption."""
    return [result for result in computation if result is not None]


class BackgroundComputation(Generic[T]):
    """A computation in the background: call `advance` once per tick until it returns True, then read `result`."""

    def __init__(self, computation: SlicedComputation[T], steps_per_tick: int) -> None:
        """Prepare `computation`; each call of `advance` runs `steps_per_tick` steps."""
        self._computation, self._steps_per_tick = computation, steps_per_tick
        self.result: T | None = None

    def advance(self) -> bool:
        """Run the steps of one tick; True if the computation is finished."""
        for _ in range(self._steps_per_tick):
            try:
                next(self._computation)
            except StopIteration as over:
                self.result = over.value
                return True
        return False


def first_clear(
    choices: Iterable[T | None],
    clearance: Callable[[T, float], SlicedComputation[float]],
    *,
    threshold: float = -np.inf,
) -> SlicedComputation[tuple[T | None, float]]:
    """The first choice that is clear, else the one with the largest clearance [m], and that clearance.

    Choices with a clearance of at most `threshold` [m] do not count; None if no choice is left. `clearance(choice,
    most)` may stop early as soon as its result cannot exceed `most`, because such a choice is not taken.
    """
    best, most = None, threshold
    for choice in choices:
        if choice is None:
            yield
            continue
        room = yield from clearance(choice, most)
        if room > most:
            best, most = choice, room
        if most >= SUFFICIENT_CLEARANCE:
            break
    return best, most
