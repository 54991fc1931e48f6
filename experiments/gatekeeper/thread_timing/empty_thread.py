"""`cyclictest` (Debian package rt-tests): lateness of a thread that does nothing, beside the same load."""

from __future__ import annotations

import re
import shutil
import subprocess

import numpy as np

from dualbrain.errors import MissingDependencyError
from experiments.engine.experiment import Row

LONGEST_US = 100_000
"""Longest delay with a line of its own in the histogram [µs]; longer ones count as this long."""


def run_cyclictest(duration_s: float, period_us: int, priority: int, late_us: int) -> Row:
    """One unit; a thread with SCHED_FIFO and locked memory sleeps until each of its periods.

    Raises:
        MissingDependencyError: `cyclictest` is not installed.
    """
    program = shutil.which("cyclictest")
    if program is None:
        raise MissingDependencyError("The program cyclictest", fix="On Debian: apt-get install rt-tests")
    options = f"-q -m -t 1 -p {priority} -i {period_us} -D {duration_s:.0f} -h {LONGEST_US}"
    done = subprocess.run([program, *options.split()], capture_output=True, text=True, check=True)
    return {**summarize_histogram(done.stdout, round(1e6 * duration_s / period_us), late_us), "real_time": True}


def summarize_histogram(printed: str, periods: int, late_us: int) -> Row:
    """Ticks, late ticks, periods without a tick and quantiles [µs] from the output of `cyclictest`."""
    lines = [(int(delay), int(count)) for delay, count in re.findall(r"^(\d{6}) (\d{6,})$", printed, re.M)]
    longest = max(map(int, re.findall(r"^# Max Latencies: (\d+)$", printed, re.M)))
    beyond = sum(map(int, re.findall(r"^# Histogram Overflows: (\d+)$", printed, re.M)))
    delays, counts = np.array([*lines, (LONGEST_US, beyond)]).T
    ticks, below = int(counts.sum()), np.cumsum(counts)
    p50, p999 = (int(delays[np.searchsorted(below, share * ticks)]) for share in (0.5, 0.999))
    late = int(counts[delays > late_us].sum())
    skipped = max(0, periods - ticks)
    return {"ticks": ticks, "late": late, "skipped": skipped, "p50_us": p50, "p999_us": p999, "max_us": longest}
