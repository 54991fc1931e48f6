"""The number of processor threads for a planner on this machine."""

from __future__ import annotations

import os

MAX_THREADS = 8
"""More threads hardly shorten an answer: a model of a gigabyte then waits for memory."""


def free_processors(usable: int, load: float) -> int:
    """The number of the `usable` processors that other processes leave idle, at least 1.

    `load` is the number of running or waiting processes (mean of a minute).
    """
    return max(1, min(MAX_THREADS, round(usable - load)))


def planner_threads(*, control_loop: bool) -> int:
    """The threads of a planner now: 1 beside a `control_loop` in real time, otherwise one for each free processor."""
    if control_loop:
        return 1
    affinity = getattr(os, "sched_getaffinity", None)
    usable = len(affinity(0)) if affinity else os.cpu_count() or 1
    return free_processors(usable, os.getloadavg()[0])
