"""Thoughts: calculations that may pause, so that no control tick waits for one.

A skill looks ahead before it moves: it solves for postures, rehearses ways, searches a floor. In one piece that takes
up to a second, and a control tick is one millisecond. So a calculation of that kind is a generator: it yields None
after every *glance*, a piece of work of some 50 µs such as one posture of the arm, and returns its answer. A story
passes the pauses on (`yield from`); after `glances` of them the tick is over, and the robot rests until the next.

Work is counted, not timed: how long a robot thinks does not depend on the machine, lockstep and real time think alike,
and a recorded contract thinks again as it did.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable
from typing import Generic, TypeVar

import numpy as np

T = TypeVar("T")
SlicedComputation = Generator[None, None, T]
"""A calculation that pauses after every glance."""
SlicedIterator = Generator[T | None, None, None]
"""Things found one after the other; None is a pause."""

STEPS_PER_SECOND = 5000.0
"""Glances in a second: five in a tick of 1 ms, which take about a quarter of it."""
SUFFICIENT_CLEARANCE = 0.004
"""A way counts as clear when the margins leave this much everywhere [m]."""


def steps_per_tick(period: float) -> int:
    """How much may be thought in one control tick of `period` [s]."""
    return max(1, round(STEPS_PER_SECOND * period))


def run_to_completion(computation: SlicedComputation[T]) -> T:
    """The answer, thought through without a pause: for whoever has no tick to keep."""
    while True:
        try:
            next(computation)
        except StopIteration as over:
            return over.value


def collect(computation: SlicedIterator[T]) -> list[T]:
    """Everything that is found, without a pause."""
    return [thing for thing in computation if thing is not None]


class BackgroundComputation(Generic[T]):
    """A thought beside something else: `go_on` once a tick until it is `over`, then take the `answer`."""

    def __init__(self, computation: SlicedComputation[T], steps_per_tick: int) -> None:
        """Nothing is thought yet; `share` glances will be each time."""
        self._computation, self._steps_per_tick = computation, steps_per_tick
        self.result: T | None = None

    def advance(self) -> bool:
        """Think on for a tick; True when it is over."""
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
    """The first choice whose way is clear, else the one with most `air` [m], and how much that is; None of nothing.

    What does not have more than `beat` [m] is as good as nothing. `air(choice, most)` may break off as soon as it knows
    that there is no more than `most`: such a choice is not taken.
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
