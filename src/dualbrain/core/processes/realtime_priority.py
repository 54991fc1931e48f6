"""Real-time priority of a control process: requested before the first tick, returned once the arm is at rest."""

from __future__ import annotations

import os
from contextlib import suppress

PRIORITY = 10
"""Priority of the control tick in the operating system's first-in-first-out class."""


def request_realtime_priority() -> None:
    """Request a real-time priority for this thread; without one, the tick timing shows the effect.

    Threads and processes that are started later inherit it.
    """
    with suppress(OSError, AttributeError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))


def release_realtime_priority() -> None:
    """Give this thread the ordinary priority again."""
    with suppress(OSError, AttributeError):
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
